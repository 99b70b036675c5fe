"""Which raw files, code and parameters produced a file.

``manifests``: the raw files of a dataset. ``graph``: the stages as DVC resolves them. ``closure``: the files behind a
module. ``digests``: what a file or folder is by content. ``provenance``: what a checkpoint carries. ``locks``: what DVC
noted of each run. ``history``: what git knows. ``targets``: what is asked about. ``tree``: its record beside today.
``raw``: raw files and frames. ``formats``, ``diff``, ``uses``, ``check``, ``rerun``: what is told of it.
"""
