"""Stage split: the subsets of all named splits, the chosen split with its leak check, and training statistics."""

import sys

from pipelines.stages.base import StagePaths, empty_reason, print_counts, read_section, write_empty


def run(paths: StagePaths) -> None:
    """Split the annotated clips; a dataset without clips gives an empty output."""
    # The name of a split, or a rule (``hoidata.splits.SplitRule``).
    split = read_section("split").get(paths.dataset)
    if reason := empty_reason(paths.annotation):
        write_empty(paths.splits, reason)
        return
    from hoidata.splits.rules import missing_parts
    from hoidata.splits.stage import split_store

    counts = split_store(paths.clips, paths.annotation, paths.splits, split)
    print_counts(paths, counts)
    for message in missing_parts(counts).values():
        print(f"{paths}: {message}; choose another split under split.{paths.dataset} of params.yaml", file=sys.stderr)
