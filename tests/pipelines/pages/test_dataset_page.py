"""The page of one dataset: counts, examples, skipped sequences; and `hoidata show`, which finds a clip by its id."""

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
import yaml

from hoidata.clips.quarantine import Quarantined
from hoidata.errors import BadInput, MissingResource
from hoidata.files.written import read_table
from hoidata.store.annotated import load_annotated
from pipelines.pages.dataset_facts import majority_verb, read_dataset
from pipelines.pages.dataset_page import (
    contact_by_object,
    count_bars,
    count_charts,
    example_ids,
    still_of,
    write_dataset_page,
)
from pipelines.pages.player import view_of
from pipelines.pages.report import ReportFolders, write_report
from pipelines.show_pages import closest_ids, dataset_of_clip, write_named_page
from tests.builders.stores import write_annotated, write_clips

SPLIT = {"by": "subject", "train": "rest", "test": ["s2"], "promises": ["subject"]}
LEFT_OUT = Quarantined("grab/s1/mug_1", "s1/mug_1.npz", "finite numbers", "NaN in <frame 3>", remedy="load again")


@pytest.fixture(scope="module")
def written(page_clip, tmp_path_factory):
    """A project folder with one dataset of four clips: the last one's hand is far from its object."""
    right, both = page_clip(), page_clip(left=True, hinged=True, frames=30)
    far = {**right.hands, "right": replace(right.hands["right"], wrist_m=right.hands["right"].wrist_m + 1.0)}
    clips = [
        replace(right, clip_id="grab/s1/box_1"),
        replace(right, clip_id="grab/s1/box_2"),
        replace(both, clip_id="grab/s2/lid_1", subject="s2", verb="open", object_words="lidded <box>"),
        replace(right, clip_id="grab/s1/box_far", hands=far),
    ]
    folder = tmp_path_factory.mktemp("written")
    write_annotated(folder / "data" / "embedded" / "grab", [*clips, LEFT_OUT], "grab", SPLIT, 0.09, quality=True)
    (folder / "params.yaml").write_text(yaml.safe_dump({"datasets": ["h2o", "grab"], "profile": "embedded"}))
    (folder / "manifests" / "embedded").mkdir(parents=True)
    (folder / "manifests" / "embedded" / "hand.json").write_text('{"present": true}')
    return folder


@pytest.fixture
def project(written, tmp_path, monkeypatch):
    """The dataset's folder in a copied project, which is the current folder."""
    shutil.copytree(written, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "data" / "embedded" / "grab"


def test_bars_count_every_clip_most_frequent_first():
    chart = count_bars("verb", ["lift", "open", "lift", None, "open", "lift"], "no label")
    assert [(name, clips) for name, clips, _ in chart.bars] == [("lift", 3), ("open", 2), ("no label", 1)]
    assert [width for _, _, width in chart.bars] == pytest.approx([100, 66.67, 33.33], abs=0.01)
    many = count_bars("object", [f"thing {number:02d}" for number in range(30)] * 2, "")
    assert len(many.bars) == 24
    assert many.rest == "and 6 others with 12 clips"


@pytest.mark.slow
def test_page_counts_lists_and_links(project, hands, tmp_path):
    text = write_dataset_page(tmp_path / "out", project, "grab", hands, "GRAB").read_text()
    assert '<dt>box</dt><dd><i style="width:100.0%"></i><span>3</span></dd>' in text
    assert "<dt>lidded &lt;box&gt;</dt>" in text
    assert "<dt>both</dt>" in text
    assert "<dt>none is active</dt>" in text
    assert "Shortest 0.80 s, median 0.80 s, longest 1.00 s." in text
    assert re.search(r"<td>grab/s1/box_far</td><td>no joint within 9 cm", text)
    assert "NaN in &lt;frame 3&gt;" in text
    assert "Of 4 clips" in text
    assert "<dt>licence</dt><dd>none: generated; derived data may be shared</dd>" in text
    links = re.findall(r'href="(clips/[^"]+)"', text)
    assert sorted(links) == ["clips/grab_s1_box_1.html", "clips/grab_s1_box_2.html", "clips/grab_s2_lid_1.html"]
    assert all((tmp_path / "out" / link).is_file() for link in links)
    assert "within 9 cm of a sampled point of the object" in text
    assert '<td>all objects</td><td class="number">4</td><td class="number">102</td>' in text


def test_minutes_are_of_frames_at_30_per_second(page_clip, hands, tmp_path):
    clips = [replace(page_clip(frames=frames), clip_id=f"grab/s1/box_{frames}") for frames in (1800, 900)]
    write_clips(tmp_path / "clips", clips, "grab")
    tiles = {name: number for number, name in read_dataset(tmp_path, "grab", hands).tiles}
    assert (tiles["clips"], tiles["frames at 30 fps"], tiles["minutes"]) == ("2", "2,700", "1.5")


def test_the_most_frequent_training_verb_is_compared_with_the_test_clips(page_clip, tmp_path):
    words = ["place", "lift", "lift", "place", "lift", "lift", "place", "open"]
    clips = [
        replace(page_clip(frames=10 + number), clip_id=f"grab/{number}", subject=f"s{1 + number // 4}", verb=verb)
        for number, verb in enumerate(words)
    ]
    root = write_annotated(tmp_path, clips, "grab", SPLIT, 0.09)
    assert majority_verb(load_annotated(root)) == [("50%", "of test clips show the most frequent training verb, lift")]
    alone = write_annotated(tmp_path / "alone", clips[:4], "grab", SPLIT, 0.09)
    assert majority_verb(load_annotated(alone)) == []


def test_contact_and_penetration_by_object_are_counted_over_frames(page_clip, hands, tmp_path):
    """The left hand is in the box in frames 10 to 19, the right in 15 to 24 of 30: a frame counts once."""
    clip = page_clip(left=True, frames=30)
    tracks = {}
    for side, first in (("left", 10), ("right", 15)):
        wrist = clip.hands[side].wrist_m + np.float32(1)
        wrist[first : first + 10] = clip.object.translation_m[first : first + 10]
        tracks[side] = replace(clip.hands[side], wrist_m=wrist)
    alone = replace(page_clip(hinged=True), clip_id="test/lid", subject="s2")
    far = {side: replace(track, wrist_m=track.wrist_m + np.float32(1)) for side, track in alone.hands.items()}
    clips = [replace(clip, hands=tracks), replace(alone, hands=far)]
    annotated = load_annotated(write_annotated(tmp_path / "grab", clips, "grab", SPLIT, 0.09, quality=True), hands)
    rows = {record.name: record for record in contact_by_object(annotated)}
    assert list(rows) == ["all objects", "box", "lidded box"]
    assert (rows["box"].touching, rows["lidded box"].touching) == ("50.0 %", "0.0 %")
    # Quality control looks at every fifth frame: 10, 15 and 20 of 0, 5, ..., 25.
    assert (rows["box"].deep, rows["lidded box"].deep, rows["lidded box"].deepest) == ("50.0 %", "0.0 %", "0.0")
    deepest = read_table(tmp_path / "grab/quality/clips.parquet").set_index("clip_id").at[clip.clip_id, "penetration_m"]
    assert rows["box"].deepest == f"{deepest * 1000:.1f}"
    assert (rows["all objects"].frames, rows["all objects"].touching) == ("54", f"{15 / 54 * 100:.1f} %")


def test_object_that_is_not_solid_has_no_depths_in_the_table(page_clip, hands, tmp_path):
    clip = page_clip()
    plate = replace(clip.object.model, faces=clip.object.model.faces[:2], name="plate")
    other = replace(page_clip(frames=30), clip_id="test/s2/open", subject="s2")
    clips = [clip, replace(other, object=replace(other.object, model=plate))]
    annotated = load_annotated(write_annotated(tmp_path / "grab", clips, "grab", SPLIT, 0.09, quality=True), hands)
    all_objects, box, open_mesh = contact_by_object(annotated)
    assert (open_mesh.name, open_mesh.deep, open_mesh.deepest) == ("plate", "not measured", "not measured")
    assert (all_objects.deep, all_objects.deepest) == (box.deep, box.deepest)


@pytest.mark.slow
def test_page_repeats_byte_for_byte(project, hands, tmp_path):
    first, second = (write_dataset_page(tmp_path / name, project, "grab", hands, examples=1) for name in "ab")
    assert first.read_bytes() == second.read_bytes()


def test_examples_cover_different_clips_first(project, hands):
    annotated = load_annotated(project, hands)
    assert example_ids(annotated, 2) == ["grab/s1/box_1", "grab/s2/lid_1"]
    assert len(example_ids(annotated, 9)) == 3


def test_still_shows_the_frame_in_which_most_points_are_touched(project, hands):
    annotated = load_annotated(project, hands)
    clip_id = "grab/s2/lid_1"
    counts = np.zeros(30, int)
    for side in ("left", "right"):
        entries = annotated.distances(clip_id, side)
        for frame, _ in set(zip(entries.frame.tolist(), entries.point.tolist(), strict=True)):
            counts[frame] += 1
    busiest = int(np.argmax(counts))
    still = still_of(annotated, clip_id, hands, "Open a box.")
    assert still.view.frames == 1
    assert still.view == view_of(annotated.clip(clip_id).take(slice(busiest, busiest + 1)), hands)


@pytest.mark.long
def test_report_links_the_page_of_each_dataset_that_has_what_it_needs(project, hands, tmp_path):
    folders, families = ReportFolders.of("embedded", tmp_path), dict.fromkeys(("h2o", "grab"), ("ground-truth",))
    page = write_report(tmp_path / "report", "embedded", families, hands, folders)
    assert 'href="grab.html"' in page.read_text()
    assert "<h1>GRAB" in (tmp_path / "report" / "grab.html").read_text()
    (project / "splits" / "splits.parquet").unlink()
    page = write_report(tmp_path / "less", "embedded", families, hands, folders)
    assert "grab.html" not in page.read_text()


def test_show_writes_the_page_of_a_clip(project, tmp_path):
    path = write_named_page("grab/s2/lid_1", "embedded", tmp_path / "pages")
    assert path == tmp_path / "pages" / "grab_s2_lid_1.html"
    assert '<p class="quiet">grab/s2/lid_1</p>' in path.read_text()
    assert dataset_of_clip("grab/s1/box_2", "embedded", ["h2o", "grab"]).dataset == "grab"


def test_unknown_clip_names_the_closest_ones(project, tmp_path):
    with pytest.raises(BadInput, match=r"grab 4\).*got grab/s2/lid_2; closest: grab/s2/lid_1"):
        write_named_page("grab/s2/lid_2", "embedded", tmp_path)
    with pytest.raises(BadInput, match="closest: grab/s1/box_far"):
        write_named_page("far", "embedded", tmp_path)
    assert closest_ids("FAR", ["s/box", "s/afar", "s/far"])[:2] == ["s/afar", "s/far"]


def test_a_skipped_sequence_is_named_with_its_reason(project, tmp_path):
    with pytest.raises(BadInput, match=r"skipped in conversion: s1/mug_1\.npz: expected finite numbers, got NaN"):
        write_named_page("grab/s1/mug_1", "embedded", tmp_path)


def test_a_missing_stage_is_named(project, tmp_path):
    with pytest.raises(MissingResource, match="h2o has no clips to show: it was not converted"):
        write_named_page("h2o", "embedded", tmp_path)
    with pytest.raises(MissingResource, match="no dataset of the profile own is converted"):
        write_named_page("grab/s1/box_1", "own", tmp_path)
    (project / "contact").rename(project / "elsewhere")
    with pytest.raises(MissingResource, match="run the stage 'contact'"):
        write_named_page("grab/s1/box_1", "embedded", tmp_path)


def test_verbs_derived_from_motion_are_counted(page_clip, hands, tmp_path):
    clips = [replace(page_clip(), clip_id=f"test/s1/{number}", verb=None) for number in range(2)]
    write_annotated(tmp_path / "toy", clips, threshold_m=0.09)
    facts = read_dataset(tmp_path / "toy", "toy", hands)
    assert facts.annotated is not None
    verb = facts.annotated.verb("test/s1/0")
    (chart,) = [one for one in count_charts(facts.annotated) if one.title == "verb"]
    assert [bar[:2] for bar in chart.bars] == [(verb, 2)]
    assert ("1", "verbs") in facts.tiles
    assert dict(facts.counts)["verb"] == [(verb, 2)]
