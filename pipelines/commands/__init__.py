"""The sub-commands of ``hoidata``, one file per group."""
