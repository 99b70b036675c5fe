"""Converts the raw files of one dataset to a clip store, in worker processes; resumes after a kill."""
