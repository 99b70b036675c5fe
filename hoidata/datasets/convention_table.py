"""Generates the table of the built-in datasets' conventions from their ``facts.toml``.

``python -m hoidata.datasets.convention_table > hoidata/datasets/CONVENTIONS.md`` writes the table.
"""

from hoidata.dataset_folders import built_in_names, dataset_facts
from hoidata.errors import BadInput

# Allowed keys of ``conventions`` in facts.toml, in the order of the table.
ROWS = (
    "unit", "handedness of the world", "meshes", "object rotation", "hand translation", "finger angles",
    "principal components", "angles beyond pi", "shape", "left shape directions", "left and right", "numbers per hand",
    "joint order", "finger tips", "parts", "hinge", "camera", "frames", "validity", "labels", "gravity",
)  # fmt: skip
HEAD = """# Conventions of the sources

Meaning of the numbers of each source, from `<dataset>/facts.toml`. Every cell has a test that fails if the adapter
follows another convention. The test compares the adapter with an independent formula and asserts that the flipped
convention is off by more than 5 mm (or by a frame, a part, a name, a side).
`tests/hoidata/datasets/<dataset>/test_contract.py` names the test of each cell. A dash means not applicable.

"""


def table() -> str:
    """CONVENTIONS.md: one row per convention, one column per built-in dataset."""
    columns = [facts for name in built_in_names() if (facts := dataset_facts(name))]
    for facts in columns:
        if unknown := sorted(facts.conventions.keys() - set(ROWS)):
            raise BadInput(f"{facts.name}/facts.toml: conventions", f"some of {', '.join(ROWS)}", ", ".join(unknown))
    lines = [("convention", *(facts.title for facts in columns)), ("---",) * (len(columns) + 1)]
    lines += [(row, *(facts.conventions.get(row, "-") for facts in columns)) for row in ROWS]
    text = "".join(f"| {' | '.join(cells)} |\n" for cells in lines)
    return HEAD + text.replace("| --- ", "|---").replace("--- |", "---|")


if __name__ == "__main__":
    print(table(), end="")
