"""Every way a store on disk can be wrong is found, and named with its file."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from hoidata.errors import BadInput, MissingResource
from hoidata.store.fields import BODY, FRAMES, INFO, SOURCE_CONTACT, TABLES, value_at
from hoidata.store.info import generated_info
from hoidata.store.store import write_store
from hoidata.store_check.check import check_store

FRAME_FILE, OBJECTS, TEMPLATES = "arrays/frames-00000.npz", "arrays/objects.npz", "arrays/templates.npz"


def change_info(key: str, value) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / "meta" / "info.json"
        info = json.loads(path.read_text())
        *above, last = key.split(".")
        inner = value_at(info, ".".join(above)) if above else info
        inner.pop(last) if value is ... else inner.update({last: value})
        path.write_text(json.dumps(info))

    return change


def change_table(name: str, column: str, row: int | None, value) -> Callable[[Path], None]:
    """Set one value of a table; row None: replace the whole column (``...``: drop it)."""

    def change(folder: Path) -> None:
        path = folder / "meta" / f"{name}.parquet"
        table = pq.read_table(path)
        index = table.schema.get_field_index(column)
        if row is None:
            table = table.remove_column(index) if value is ... else table.append_column(column, value)
        else:
            values = table[column].to_pylist()
            values[row] = value(values[row]) if callable(value) else value
            table = table.set_column(index, column, pa.array(values, table.schema.field(index).type))
        pq.write_table(table, path)

    return change


def change_arrays(file: str, member: str, value) -> Callable[[Path], None]:
    """Replace one member by ``value(array)``; ``...`` drops it."""

    def change(folder: Path) -> None:
        path = folder / file
        with np.load(path) as archive:
            arrays = {name: archive[name] for name in archive.files}
        if value is ...:
            del arrays[member]
        else:
            arrays[member] = value(arrays.get(member))
        np.savez(path, **arrays)

    return change


def with_value(index, value) -> Callable[[np.ndarray], np.ndarray]:
    def change(array: np.ndarray) -> np.ndarray:
        array[index] = value
        return array

    return change


def remove(file: str) -> Callable[[Path], None]:
    return lambda folder: (folder / file).unlink()


def write(file: str, data: bytes) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / file).parent.mkdir(exist_ok=True)
        (folder / file).write_bytes(data)

    return change


def cut(file: str) -> Callable[[Path], None]:
    return lambda folder: (folder / file).write_bytes((folder / file).read_bytes()[:-300])


def cast_column(folder: Path) -> None:
    path = folder / "meta" / "sequences.parquet"
    table = pq.read_table(path)
    index = table.schema.get_field_index("n_frames")
    pq.write_table(table.set_column(index, "n_frames", table["n_frames"].cast(pa.int64())), path)


def reorder_columns(folder: Path) -> None:
    path = folder / "meta" / "files.parquet"
    pq.write_table(pq.read_table(path).select(["size", "path", "sha256"]), path)


def swap_clips(folder: Path) -> None:
    path = folder / "meta" / "sequences.parquet"
    pq.write_table(pq.read_table(path).take([1, 0, 2]), path)


def reverse_objects(folder: Path) -> None:
    path = folder / "meta" / "objects.parquet"
    pq.write_table(pq.read_table(path).take([1, 0]), path)


def use_boxes_only(folder: Path) -> None:
    change_table("sequences", "object", 1, "box")(folder)
    change_table("sequences", "other_objects", 1, ["box", "box"])(folder)


def repeat_all(folder: Path) -> None:
    path = folder / "meta" / "files.parquet"
    table = pq.read_table(path)
    pq.write_table(pa.concat_tables([table, table]), path)


SEQ, OBJ = "meta/sequences.parquet", "meta/objects.parquet"
FAULTS: dict[str, tuple[Callable[[Path], None], str]] = {
    # info.json
    "no JSON": (write("meta/info.json", b"{"), "meta/info.json"),
    "a list": (write("meta/info.json", b"[1]"), "meta/info.json"),
    "no version": (change_info("schema_version", ...), "meta/info.json"),
    "an odd version": (change_info("schema_version", "one"), "meta/info.json"),
    "a newer minor version": (change_info("schema_version", "1.9.0"), "meta/info.json"),
    "a newer major version": (change_info("schema_version", "2.0.0"), "meta/info.json"),
    "no licence": (change_info("licence", ...), "meta/info.json: licence"),
    "no frame": (change_info("frame", ...), "meta/info.json: frame.handedness"),
    "a left-handed frame": (change_info("frame.handedness", "left"), "meta/info.json: frame.handedness"),
    "an up axis of w": (change_info("frame.up_axis", "w"), "meta/info.json: frame.up_axis"),
    "synthetic as text": (change_info("synthetic", "yes"), "meta/info.json: synthetic"),
    "a text for the frame": (change_info("frame", "z up"), "meta/info.json: frame.handedness"),
    **{
        f"a wrong count of {name}": (change_info(f"counts.{name}", 77), f"meta/info.json: counts.{name}")
        for name in ("clips", "frames", "objects", "files", "quarantined")
    },
    # files
    **{f"no {name} table": (remove(f"meta/{name}.parquet"), f"meta/{name}.parquet") for name in TABLES},
    "no shard": (remove(FRAME_FILE), FRAME_FILE),
    "no body shard": (remove("arrays/body-00000.npz"), "arrays/body-00000.npz"),
    "no contact shard": (remove("arrays/source_contact-00000.npz"), "arrays/source_contact-00000.npz"),
    "no objects": (remove(OBJECTS), OBJECTS),
    "no templates": (remove(TEMPLATES), TEMPLATES),
    "a second shard": (write("arrays/frames-00001.npz", b""), "arrays/frames-00001.npz"),
    "a file of notes": (write("meta/notes.txt", b"hello"), "meta/notes.txt"),
    "a folder of notes": (write("notes/a.txt", b"hello"), "notes/a.txt"),
    "a truncated table": (cut(SEQ), SEQ),
    "a table of text": (write(OBJ, b"hello"), OBJ),
    "a truncated shard": (cut(FRAME_FILE), FRAME_FILE),
    "an empty shard": (write(FRAME_FILE, b""), FRAME_FILE),
    "truncated objects": (cut(OBJECTS), OBJECTS),
    # columns
    "a column less": (change_table("sequences", "camera_row", None, ...), f"{SEQ}: camera_row"),
    "a column more": (change_table("sequences", "mood", None, pa.array(["", "", ""])), f"{SEQ}: mood"),
    "a column of another type": (cast_column, f"{SEQ}: n_frames"),
    "columns in another order": (reorder_columns, "meta/files.parquet"),
    # sequences
    "no id": (change_table("sequences", "clip_id", 0, None), f"{SEQ}: clip_id"),
    "an empty id": (change_table("sequences", "clip_id", 0, ""), f"{SEQ}: clip_id"),
    "an id twice": (change_table("sequences", "clip_id", 1, "test/s1/a"), f"{SEQ}: clip_id"),
    "no other objects": (change_table("sequences", "other_objects", 0, None), f"{SEQ}: other_objects"),
    "a gap in a list": (change_table("sequences", "source_files", 1, [0, None]), f"{SEQ}: source_files"),
    "a third hand": (change_table("sequences", "labelled_hand", 0, "third"), f"{SEQ}: labelled_hand"),
    "hands from nowhere": (change_table("sequences", "hands_from", 0, "guesses"), f"{SEQ}: hands_from"),
    "a gravity of 9.81": (change_table("sequences", "gravity", 2, [0.0, 0.0, -9.81]), f"{SEQ}: gravity"),
    "a flat gravity": (change_table("sequences", "gravity", 2, [0.0, -1.0]), f"{SEQ}: gravity"),
    "gravity is NaN": (change_table("sequences", "gravity", 2, [0.0, 0.0, float("nan")]), f"{SEQ}: gravity"),
    "gravity without a reason": (change_table("sequences", "gravity_note", 0, ""), "test/s1/a: gravity_note"),
    "an error without a fit": (change_table("sequences", "fit_error_m", 2, 0.1), "test/s1/c: fit_error_m"),
    "a 3 x 3 transform": (change_table("sequences", "source_from_world", 0, [1.0] * 9), f"{SEQ}: source_from_world"),
    "a singular transform": (
        change_table("sequences", "source_from_world", 0, [0.0] * 15 + [1.0]),
        "test/s1/a: source_from_world",
    ),
    "no rate": (change_table("sequences", "source_fps", 0, 0.0), f"{SEQ}: source_fps"),
    "no frames": (change_table("sequences", "n_frames", 0, 0), f"{SEQ}: n_frames"),
    "a frame too many": (change_table("sequences", "n_frames", 2, lambda n: n + 1), FRAME_FILE),
    "a frame too few": (change_table("sequences", "n_frames", 2, lambda n: n - 1), FRAME_FILE),
    "another shard": (change_table("sequences", "shard", 2, 5), f"{SEQ}: shard"),
    "clips in another order": (swap_clips, f"{SEQ}: first_row of test/s2/b"),
    **{
        f"{column} is one off": (change_table("sequences", column, 2, lambda n: n + 1), f"{SEQ}: {column} of test/s1/c")
        for column in (
            *("first_row", "left_betas_row", "right_betas_row", "camera_row", "body_row"),
            *("source_contact_row", "left_valid_frames", "right_valid_frames", "first_source_frame"),
            *("last_source_frame", "other_row"),
        )
    },
    "overlapping clips": (change_table("sequences", "first_row", 1, lambda n: n - 1), f"{SEQ}: first_row of test/s2/b"),
    "rows beyond the end": (change_table("sequences", "first_row", 2, 10**9), f"{SEQ}: first_row of test/s1/c"),
    "expressions of a clip without": (change_table("sequences", "expression_row", 2, 40), "arrays/body-00000.npz"),
    "two rows of betas": (change_table("sequences", "left_betas_count", 0, 2), f"{SEQ}: left_betas_count"),
    "contacts too few": (
        change_table("sequences", "source_contact_count", 2, lambda n: n - 1),
        "arrays/source_contact-00000.npz: frame",
    ),
    # references
    "an unknown object": (change_table("sequences", "object", 0, "mug"), f"{SEQ}: object"),
    "an unknown second object": (
        change_table("sequences", "other_objects", 1, ["mug", "box"]),
        f"{SEQ}: other_objects",
    ),
    "an unknown file": (change_table("sequences", "source_files", 1, [0, 2]), f"{SEQ}: source_files"),
    "a file before the first": (change_table("sequences", "source_files", 1, [0, -1]), f"{SEQ}: source_files"),
    "an unknown template": (change_table("sequences", "right_template", 1, "00" * 8), TEMPLATES),
    "a hinge too many": (change_table("sequences", "articulated", 0, True), f"{SEQ}: articulated"),
    # objects
    "an object of no clip": (use_boxes_only, f"{OBJ}: object"),
    "an object twice": (change_table("objects", "object", 1, "box"), f"{OBJ}: object"),
    "objects in another order": (reverse_objects, f"{OBJ}: object"),
    "another digest": (change_table("objects", "digest", 0, "ab" * 32), f"{OBJ}: digest of box"),
    "a vertex count": (change_table("objects", "n_vertices", 0, 9), f"{OBJECTS}: box/vertices_m"),
    "a face count": (change_table("objects", "n_faces", 0, 9), f"{OBJECTS}: box/faces"),
    "a hinge without axis": (change_table("objects", "hinge_axis", 1, None), f"{OBJ}: hinge_axis"),
    "a hinge on a rigid object": (change_table("objects", "hinge_origin_m", 0, [0.0] * 3), f"{OBJ}: hinge_origin_m"),
    "a long hinge axis": (change_table("objects", "hinge_axis", 1, [2.0, 0.0, 0.0]), f"{OBJ}: hinge_axis"),
    "another hinge origin": (change_table("objects", "hinge_origin_m", 1, [9.0, 0, 0]), f"{OBJ}: digest of hinged_box"),
    "a moved vertex": (change_arrays(OBJECTS, "box/vertices_m", with_value((0, 0), 0.3)), f"{OBJ}: digest of box"),
    "a vertex that is not there": (change_arrays(OBJECTS, "box/faces", with_value((0, 0), 8)), f"{OBJECTS}: box/faces"),
    "a third part": (change_arrays(OBJECTS, "box/part", with_value(0, 2)), f"{OBJECTS}: box/part"),
    "a mesh less": (change_arrays(OBJECTS, "box/part", ...), f"{OBJECTS}: box/part"),
    "a mesh more": (change_arrays(OBJECTS, "mug/part", lambda _: np.zeros(3, np.uint8)), f"{OBJECTS}: mug/part"),
    "a mesh of NaN": (change_arrays(OBJECTS, "box/vertices_m", with_value(0, np.nan)), f"{OBJECTS}: box/vertices_m"),
    # files
    "a file twice": (repeat_all, "meta/files.parquet: path"),
    "an absolute path": (change_table("files", "path", 0, "/etc/passwd"), "meta/files.parquet: path"),
    "a path that leaves": (change_table("files", "path", 0, "../x"), "meta/files.parquet: path"),
    "a negative size": (change_table("files", "size", 0, -1), "meta/files.parquet: size"),
    "a short digest": (change_table("files", "sha256", 0, "ab"), "meta/files.parquet: sha256"),
    "no remedy": (change_table("quarantine", "remedy", 0, None), "meta/quarantine.parquet: remedy"),
    # arrays
    **{
        f"no {field.name}": (change_arrays(FRAME_FILE, field.name, ...), f"{FRAME_FILE}: {field.name}")
        for field in FRAMES.fields
    },
    "a member more": (change_arrays(FRAME_FILE, "mood", lambda _: np.zeros(3)), f"{FRAME_FILE}: mood"),
    "half precision": (
        change_arrays(FRAME_FILE, "left_wrist_m", lambda a: a.astype(np.float16)),
        f"{FRAME_FILE}: left_wrist_m",
    ),
    "44 finger angles": (
        change_arrays(FRAME_FILE, "right_hand_pose", lambda a: a[:, 1:]),
        f"{FRAME_FILE}: right_hand_pose",
    ),
    "a flat array": (change_arrays(FRAME_FILE, "object_rotvec", np.ravel), f"{FRAME_FILE}: object_rotvec"),
    "a scalar": (change_arrays(FRAME_FILE, "object_hinge_rad", lambda a: a[0]), f"{FRAME_FILE}: object_hinge_rad"),
    "a row less": (change_arrays(FRAME_FILE, "left_valid", lambda a: a[1:]), f"{FRAME_FILE}: left_valid"),
    "flags of 2": (
        change_arrays(FRAME_FILE, "left_valid", lambda a: (2 * a.astype(np.uint8)).view(bool)),
        f"{FRAME_FILE}: left_valid",
    ),
    "NaN in a hand that is not valid": (
        change_arrays(FRAME_FILE, "left_wrist_m", with_value((34, 0), np.nan)),
        f"{FRAME_FILE}: left_wrist_m",
    ),
    "infinity": (
        change_arrays(FRAME_FILE, "camera_position_m", with_value((0, 0), np.inf)),
        f"{FRAME_FILE}: camera_position_m",
    ),
    "NaN in a body": (change_arrays("arrays/body-00000.npz", "expression", with_value((0, 0), np.nan)), "arrays/body"),
    "falling source frames": (
        change_arrays(FRAME_FILE, "source_frames", with_value(3, 2)),
        "arrays/frames-*.npz: source_frames of test/s1/a",
    ),
    "a rigid hinge": (
        change_arrays(FRAME_FILE, "object_hinge_rad", with_value(3, 0.2)),
        "arrays/frames-*.npz: object_hinge_rad of test/s1/a",
    ),
    "another template": (
        change_arrays(TEMPLATES, "0" * 16, lambda _: np.zeros((778, 3), np.float32)),
        f"{TEMPLATES}: {'0' * 16}",
    ),
    "millimetres": (
        change_arrays(FRAME_FILE, "object_translation_m", lambda a: a * np.float32(1000)),
        "test/s1/a: object 0",
    ),
    "a contact beyond the mesh": (
        change_arrays("arrays/source_contact-00000.npz", "vertex", with_value(-1, 8)),
        "test/s1/c: source_contact.vertex",
    ),
}


def test_a_sound_store_has_no_problems(folder, tmp_path):
    assert check_store(folder) == []
    write_store(tmp_path / "empty", [], generated_info("test"))
    assert check_store(tmp_path / "empty") == []


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_found_and_named_with_its_file(folder, name):
    break_it, where = FAULTS[name]
    break_it(folder)
    problems = check_store(folder)
    assert any(problem.where.startswith(where) for problem in problems), [str(problem) for problem in problems]
    assert all(problem.expected and problem.got and problem.remedy for problem in problems)


def test_clips_stand_in_the_order_of_their_shards(clips, tmp_path, monkeypatch):
    monkeypatch.setattr("hoidata.store.shards.FRAMES_PER_SHARD", 1)
    write_store(tmp_path / "clips", clips, generated_info("test"))
    assert check_store(tmp_path / "clips") == []
    swap_clips(tmp_path / "clips")
    assert f"{SEQ}: shard" in [problem.where for problem in check_store(tmp_path / "clips")]


def test_a_changed_template_is_found(folder):
    with np.load(folder / TEMPLATES) as archive:
        (name,) = archive.files
    change_arrays(TEMPLATES, name, with_value((5, 1), 0.05))(folder)
    (problem,) = check_store(folder)
    assert problem.where == f"{TEMPLATES}: {name}"


def test_a_plausible_number_changed_in_place_is_found(folder):
    path = folder / FRAME_FILE
    with np.load(path) as archive:
        wrist_m = archive["right_wrist_m"][1]
    data, old = path.read_bytes(), wrist_m.tobytes()
    assert data.count(old) == 1
    path.write_bytes(data.replace(old, (wrist_m + np.float32(0.05)).tobytes()))
    (problem,) = check_store(folder)
    assert problem.where == f"{FRAME_FILE}: right_wrist_m"
    assert "checksum" in problem.got


def test_every_member_of_every_shard_is_held_to_its_type(folder):
    for file in (FRAMES, BODY, SOURCE_CONTACT):
        path = folder / file.path.replace("*", "00000")
        sound = path.read_bytes()
        for field in file.fields:
            change_arrays(path.name, field.name, lambda array: array.astype(np.complex64))(folder / "arrays")
            assert [problem.where for problem in check_store(folder)] == [f"arrays/{path.name}: {field.name}"]
            path.write_bytes(sound)


def test_every_fact_of_info_is_needed(folder):
    sound = (folder / INFO.path).read_bytes()
    for field in INFO.fields:
        change_info(field.name, ...)(folder)
        assert any(problem.where.startswith(INFO.path) for problem in check_store(folder)), field.name
        (folder / INFO.path).write_bytes(sound)


def test_all_faults_of_a_store_are_listed_at_once(folder):
    for name in ("a wrong count of clips", "a gravity of 9.81", "another digest", "infinity", "a file of notes"):
        FAULTS[name][0](folder)
    assert len(check_store(folder)) == 5


def test_what_is_no_store_is_refused(tmp_path):
    with pytest.raises(MissingResource, match="no store"):
        check_store(tmp_path)
    with pytest.raises(MissingResource, match="no folder"):
        check_store(tmp_path / "none")


def test_the_command_says_what_is_wrong_and_ends_with_1(folder):
    from pipelines.cli import app

    sound = CliRunner().invoke(app, ["validate", str(folder)])
    assert (sound.exit_code, sound.output) == (0, f"{folder}: sound, 3 clips, schema 1.1.0\n")
    change_table("objects", "digest", 0, "ab" * 32)(folder)
    broken = CliRunner().invoke(app, ["validate", str(folder)])
    assert broken.exit_code == 1
    assert "meta/objects.parquet: digest of box: expected " in broken.output
    assert "1 problem" in broken.output


def test_the_command_refuses_what_is_no_store(tmp_path):
    from pipelines.cli import app

    result = CliRunner().invoke(app, ["validate", str(tmp_path)])
    assert result.exit_code != 0
    assert isinstance(result.exception, MissingResource | BadInput)
