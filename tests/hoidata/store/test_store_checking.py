"""Every way a store on disk can be wrong is found, and named with its file."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from hoidata.errors import MissingResource
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


def rewrite_table(name: str, change: Callable[[pa.Table], pa.Table]) -> Callable[[Path], None]:
    def rewrite(folder: Path) -> None:
        path = folder / "meta" / f"{name}.parquet"
        pq.write_table(change(pq.read_table(path)), path)

    return rewrite


def change_table(name: str, column: str, number: int | None, value) -> Callable[[Path], None]:
    """Set one value of a table; number None: replace the whole column (``...``: drop it)."""

    def change(table: pa.Table) -> pa.Table:
        index = table.schema.get_field_index(column)
        if number is None:
            return table.remove_column(index) if value is ... else table.append_column(column, value)
        values = table[column].to_pylist()
        values[number] = value(values[number]) if callable(value) else value
        return table.set_column(index, column, pa.array(values, table.schema.field(index).type))

    return rewrite_table(name, change)


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


def with_wide_counts(table: pa.Table) -> pa.Table:
    index = table.schema.get_field_index("n_frames")
    return table.set_column(index, "n_frames", table["n_frames"].cast(pa.int64()))


cast_column = rewrite_table("sequences", with_wide_counts)
reorder_columns = rewrite_table("files", lambda table: table.select(["size", "path", "sha256"]))
swap_clips = rewrite_table("sequences", lambda table: table.take([1, 0, 2]))
reverse_objects = rewrite_table("objects", lambda table: table.take([1, 0]))
repeat_all = rewrite_table("files", lambda table: pa.concat_tables([table, table]))


def use_boxes_only(folder: Path) -> None:
    change_table("sequences", "object", 1, "box")(folder)
    change_table("sequences", "other_objects", 1, ["box", "box"])(folder)


SEQ, OBJ = "meta/sequences.parquet", "meta/objects.parquet"
Fault = tuple[Callable[[Path], None], str]


def in_frames(member: str, value) -> Fault:
    return change_arrays(FRAME_FILE, member, value), f"{FRAME_FILE}: {member}"


def in_objects(member: str, value) -> Fault:
    return change_arrays(OBJECTS, member, value), f"{OBJECTS}: {member}"


def in_clips(column: str, number: int | None, value) -> Fault:
    return change_table("sequences", column, number, value), f"{SEQ}: {column}"


def in_meshes(column: str, number: int | None, value) -> Fault:
    return change_table("objects", column, number, value), f"{OBJ}: {column}"


def in_info(key: str, value) -> Fault:
    return change_info(key, value), f"meta/info.json: {key}"


FAULTS: dict[str, Fault] = {
    # info.json
    "no JSON": (write("meta/info.json", b"{"), "meta/info.json"),
    "a list": (write("meta/info.json", b"[1]"), "meta/info.json"),
    "an odd version": (change_info("schema_version", "one"), "meta/info.json"),
    "a newer minor version": (change_info("schema_version", "1.9.0"), "meta/info.json"),
    "a newer major version": (change_info("schema_version", "2.0.0"), "meta/info.json"),
    "a left-handed frame": in_info("frame.handedness", "left"),
    "an up axis of w": in_info("frame.up_axis", "w"),
    "synthetic as text": in_info("synthetic", "yes"),
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
    "a column less": in_clips("camera_row", None, ...),
    "a column more": in_clips("mood", None, pa.array(["", "", ""])),
    "a column of another type": (cast_column, f"{SEQ}: n_frames"),
    "columns in another order": (reorder_columns, "meta/files.parquet"),
    # sequences
    "no id": in_clips("clip_id", 0, None),
    "an empty id": in_clips("clip_id", 0, ""),
    "an id twice": in_clips("clip_id", 1, "test/s1/a"),
    "no other objects": in_clips("other_objects", 0, None),
    "a gap in a list": in_clips("source_files", 1, [0, None]),
    "a third hand": in_clips("labelled_hand", 0, "third"),
    "hands from nowhere": in_clips("hands_from", 0, "guesses"),
    "a gravity of 9.81": in_clips("gravity", 2, [0.0, 0.0, -9.81]),
    "a flat gravity": in_clips("gravity", 2, [0.0, -1.0]),
    "gravity is NaN": in_clips("gravity", 2, [0.0, 0.0, float("nan")]),
    "gravity without a reason": (change_table("sequences", "gravity_note", 0, ""), "test/s1/a: gravity_note"),
    "an error without a fit": (change_table("sequences", "fit_error_m", 2, 0.1), "test/s1/c: fit_error_m"),
    "a 3 x 3 transform": in_clips("source_from_world", 0, [1.0] * 9),
    "a singular transform": (
        change_table("sequences", "source_from_world", 0, [0.0] * 15 + [1.0]),
        "test/s1/a: source_from_world",
    ),
    "no rate": in_clips("source_fps", 0, 0.0),
    "no frames": in_clips("n_frames", 0, 0),
    "a frame too many": (change_table("sequences", "n_frames", 2, lambda n: n + 1), FRAME_FILE),
    "a frame too few": (change_table("sequences", "n_frames", 2, lambda n: n - 1), FRAME_FILE),
    "another shard": in_clips("shard", 2, 5),
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
    "two rows of betas": in_clips("left_betas_count", 0, 2),
    "contacts too few": (
        change_table("sequences", "source_contact_count", 2, lambda n: n - 1),
        "arrays/source_contact-00000.npz: frame",
    ),
    # references
    "an unknown object": in_clips("object", 0, "mug"),
    "an unknown second object": in_clips("other_objects", 1, ["mug", "box"]),
    "an unknown file": in_clips("source_files", 1, [0, 2]),
    "a file before the first": in_clips("source_files", 1, [0, -1]),
    "an unknown template": (change_table("sequences", "right_template", 1, "00" * 8), TEMPLATES),
    "a hinge too many": in_clips("articulated", 0, True),
    # objects
    "an object of no clip": (use_boxes_only, f"{OBJ}: object"),
    "an object twice": in_meshes("object", 1, "box"),
    "objects in another order": (reverse_objects, f"{OBJ}: object"),
    "another digest": (change_table("objects", "digest", 0, "ab" * 32), f"{OBJ}: digest of box"),
    "a vertex count": (change_table("objects", "n_vertices", 0, 9), f"{OBJECTS}: box/vertices_m"),
    "a face count": (change_table("objects", "n_faces", 0, 9), f"{OBJECTS}: box/faces"),
    "a hinge without axis": in_meshes("hinge_axis", 1, None),
    "a hinge on a rigid object": in_meshes("hinge_origin_m", 0, [0.0] * 3),
    "a long hinge axis": in_meshes("hinge_axis", 1, [2.0, 0.0, 0.0]),
    "another hinge origin": (change_table("objects", "hinge_origin_m", 1, [9.0, 0, 0]), f"{OBJ}: digest of hinged_box"),
    "a moved vertex": (change_arrays(OBJECTS, "box/vertices_m", with_value((0, 0), 0.3)), f"{OBJ}: digest of box"),
    "a vertex that is not there": in_objects("box/faces", with_value((0, 0), 8)),
    "a third part": in_objects("box/part", with_value(0, 2)),
    "a mesh less": in_objects("box/part", ...),
    "a mesh more": in_objects("mug/part", lambda _: np.zeros(3, np.uint8)),
    "a mesh of NaN": in_objects("box/vertices_m", with_value(0, np.nan)),
    # files
    "a file twice": (repeat_all, "meta/files.parquet: path"),
    "an absolute path": (change_table("files", "path", 0, "/etc/passwd"), "meta/files.parquet: path"),
    "a path that leaves": (change_table("files", "path", 0, "../x"), "meta/files.parquet: path"),
    "a negative size": (change_table("files", "size", 0, -1), "meta/files.parquet: size"),
    "a short digest": (change_table("files", "sha256", 0, "ab"), "meta/files.parquet: sha256"),
    "no remedy": (change_table("quarantine", "remedy", 0, None), "meta/quarantine.parquet: remedy"),
    # arrays
    **{f"no {field.name}": in_frames(field.name, ...) for field in FRAMES.fields},
    "a member more": in_frames("mood", lambda _: np.zeros(3)),
    "44 finger angles": in_frames("right_hand_pose", lambda a: a[:, 1:]),
    "a flat array": in_frames("object_rotvec", np.ravel),
    "a scalar": in_frames("object_hinge_rad", lambda a: a[0]),
    "a number less": in_frames("left_valid", lambda a: a[1:]),
    "flags of 2": in_frames("left_valid", lambda a: (2 * a.astype(np.uint8)).view(bool)),
    "NaN in a hand that is not valid": in_frames("left_wrist_m", with_value((34, 0), np.nan)),
    "infinity": in_frames("camera_position_m", with_value((0, 0), np.inf)),
    "NaN in a body": (change_arrays("arrays/body-00000.npz", "expression", with_value((0, 0), np.nan)), "arrays/body"),
    "falling source frames": (
        change_arrays(FRAME_FILE, "source_frames", with_value(3, 1)),  # a 2 is the mark of a frame made after frame 2
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
    break_it, source = FAULTS[name]
    break_it(folder)
    problems = check_store(folder)
    assert any(problem.where.startswith(source) for problem in problems), [str(problem) for problem in problems]
    assert all(problem.expected and problem.got and problem.remedy for problem in problems)


def test_clips_stand_in_the_order_of_their_shards(clips, tmp_path, monkeypatch):
    monkeypatch.setattr("hoidata.store.writing.FRAMES_PER_SHARD", 1)
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


def test_a_folder_that_is_not_a_store_is_refused(tmp_path):
    with pytest.raises(MissingResource, match="is not a store"):
        check_store(tmp_path)
    with pytest.raises(MissingResource, match="is not a folder"):
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
