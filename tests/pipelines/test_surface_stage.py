"""Stage surface in the pipeline: its settings, what quality control left out, and turning it off."""

import shutil

import pytest

from hoidata.errors import BadInput, MissingResource
from hoidata.store.info import generated_info
from hoidata.store.store import write_store
from hoidata.surface.store import open_surface
from pipelines.stages import contact, quality, surface
from pipelines.stages.base import StagePaths, empty_reason, write_empty
from tests.builders.clips import jumping

PATHS = StagePaths("embedded", "grab")


@pytest.fixture
def with_surface(stage_folder):
    """Call it with settings of the stage; few points."""
    stage_folder(contact={"points": 64})
    return lambda **settings: stage_folder(contact={"points": 64}, surface=settings)


def test_clips_are_measured_and_those_quality_control_left_out_are_listed_with_its_reason(
    with_surface, make_clip, capsys
):
    clips = [make_clip(40, seed=3, clip_id=f"test/s1/{number}") for number in range(2)]
    clips[1] = jumping(clips[1], 20, 0.5)
    write_store(PATHS.clips, clips, generated_info("grab"))
    quality.run(PATHS)
    contact.run(PATHS)
    surface.run(PATHS)
    store = open_surface(PATHS.surface)
    assert store.ids == ["test/s1/0"]
    assert store.info["points"] == 64
    assert store.touched("test/s1/0", "right").any()
    assert store.clips.at["test/s1/1", "reason"].startswith("left out by quality control: largest sudden step")
    assert "2 clips, 1 left_out, 40 frames" in capsys.readouterr().out


def test_contact_and_quality_control_have_to_run_first(with_surface, make_clip):
    write_store(PATHS.clips, [make_clip(4)], generated_info("grab"))
    with pytest.raises(MissingResource, match="run the stage 'contact'"):
        surface.run(PATHS)
    contact.run(PATHS)
    with pytest.raises(MissingResource, match="run the stage 'quality'"):
        surface.run(PATHS)


def test_empty_dataset_passes_through_and_the_stage_can_be_turned_off(with_surface, make_clip):
    write_empty(PATHS.clips, "grab is not present")
    surface.run(PATHS)
    assert empty_reason(PATHS.surface) == "grab is not present"
    shutil.rmtree(PATHS.clips)
    write_store(PATHS.clips, [make_clip(4)], generated_info("grab"))
    with_surface(enabled=False)
    surface.run(PATHS)
    assert empty_reason(PATHS.surface) == "surface.enabled is false in params.yaml"


def test_unknown_setting_is_named_and_a_threshold_of_nothing_refused(with_surface, make_clip):
    write_store(PATHS.clips, [make_clip(40)], generated_info("grab"))
    with_surface(touch_mm=5)
    with pytest.raises(BadInput, match="touch_mm"):
        surface.run(PATHS)
    quality.run(PATHS)
    contact.run(PATHS)
    with_surface(touch_m=0)
    with pytest.raises(BadInput, match=r"surface\.touch_m"):
        surface.run(PATHS)
