"""Which raw files, code and parameters produced a file.

Records: ``manifests`` (raw files of a dataset), ``graph`` (DVC stages), ``locks`` (dvc.lock), ``provenance`` (header
of a checkpoint), ``raw`` (raw files and frames), ``history`` (git), ``closure`` (code that a module imports),
``digests``.
Questions: ``targets`` (the file in question), ``tree`` (compare its record with today), ``formats``, ``diff``,
``uses``, ``check``, ``rerun``.
"""
