"""A mesh whose faces cover nothing is refused where it is read, before anything is sampled from it."""

from pathlib import Path

import pytest

from hoidata.errors import BadInput
from hoidata.objects.mesh import load_mesh


def test_a_mesh_of_flattened_faces_is_refused_with_its_path(tmp_path: Path) -> None:
    path = tmp_path / "line.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    with pytest.raises(BadInput, match=r"line\.obj: expected faces with area, got 1 faces without"):
        load_mesh(path)
