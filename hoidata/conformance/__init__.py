"""Tests any adapter on raw files: built-in ones and those of other packages."""
