"""Which raw files, code and parameters produced a file.

``manifests``: the raw files of a dataset. ``graph``: the stages as dvc.yaml states them. ``digests``: what a file,
folder or piece of code is by content. ``provenance``: what a checkpoint carries. ``tree``: that, compared with today.
"""
