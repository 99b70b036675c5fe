"""Sentences, hand type and text features of clips, and reading of prompts."""
