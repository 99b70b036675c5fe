"""Which raw files, code and parameters produced a file.

``manifests``: the raw files of a dataset. ``graph``: the stages as DVC resolves them. ``closure``: the files behind a
module. ``digests``: what a file or folder is by content. ``provenance``: what a checkpoint carries. ``tree``: that,
compared with today.
"""
