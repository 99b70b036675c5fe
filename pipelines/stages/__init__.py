"""One short function per DVC stage, one file per stage: each file is exactly the code dvc.yaml names for it."""
