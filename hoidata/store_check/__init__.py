"""Checks a store against its schema (``store/fields.py``), and generates the schema page."""
