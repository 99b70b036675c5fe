"""Stores in the forms other projects read, each with the licences of its arrays (``hoidata export``)."""
