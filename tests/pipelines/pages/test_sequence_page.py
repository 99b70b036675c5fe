"""The page of a sequence shows each of its clips with words, hands and frames."""

from dataclasses import replace

import pytest

from hoidata.errors import BadInput
from hoidata.store.annotated import load_annotated
from pipelines.pages.sequence_page import write_sequence_page
from pipelines.show_pages import write_page_from
from tests.builders.stores import write_annotated

SPLIT = {"by": "subject", "train": "rest", "validation": [], "test": ["s9"]}


@pytest.fixture
def dataset(page_clip, tmp_path):
    """Two clips of s1/long, the later one first and hinged, and one of another sequence."""
    rigid, hinged = page_clip(), page_clip(left=True, hinged=True, frames=30)
    clips = [
        replace(hinged, clip_id="grab/s1/long/0201-0230", verb="open <it>", sequence="s1/long"),
        replace(rigid, clip_id="grab/s1/long/0011-0034", sequence="s1/long"),
        replace(rigid, clip_id="grab/s1/other", sequence="s1/other"),
    ]
    for number, start in enumerate((200, 10, 0)):
        clips[number] = replace(clips[number], source_frames=clips[number].source_frames + start)
    return write_annotated(tmp_path / "grab", clips, "grab", SPLIT, 0.09, quality=True)


def test_clips_are_listed_in_the_order_of_their_frames(dataset, hands, tmp_path):
    text = write_sequence_page(tmp_path / "page.html", load_annotated(dataset, hands), "s1/long").read_text()
    assert "<h1>grab/s1/long" in text
    first, second = text.index("<td>grab/s1/long/0011-0034</td>"), text.index("<td>grab/s1/long/0201-0230</td>")
    assert first < second
    assert "<td>10 to 33</td>" in text[first:second]
    assert "<td>both</td>" in text[second:]
    assert "grab/s1/other" not in text
    assert "<it>" not in text
    again = write_sequence_page(tmp_path / "again.html", load_annotated(dataset, hands), "s1/long").read_text()
    assert again == text


def test_show_writes_the_page_of_a_sequence_for_its_name(dataset, hands, tmp_path):
    path = write_page_from(dataset, "grab/s1/long", hands, tmp_path / "pages")
    assert path == tmp_path / "pages" / "grab_s1_long.html"
    assert "The clips cut from this sequence" in path.read_text()
    with pytest.raises(BadInput, match="got grab/s1/short"):
        write_page_from(dataset, "grab/s1/short", hands, tmp_path)
