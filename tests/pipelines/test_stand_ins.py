"""Data made without MANO or CLIP comes with a warning in tables, cards and pages."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from hoidata.conversion.convert import convert_dataset
from hoidata.datasets import get_adapter
from hoidata.hands import load_embedded_hands, load_mano_hands
from hoidata.store.info import embedded_hand_warning
from hoidata.store.store import open_store
from pipelines.commands.adapters import _hands
from pipelines.commands.store_facts import fact_rows
from pipelines.exports.describe import dataset_card
from pipelines.exports.motion import Format
from pipelines.pages.report import _stand_ins
from pipelines.show_pages import write_stored_clip
from tests.builders import arctic, grab, h2o, hoi4d, hot3d, oakink2, taco
from tests.builders.mano import write_mano_pickle

WRITERS = {
    "arctic": arctic.write_two, "grab": grab.write_two, "h2o": h2o.write_two, "hoi4d": hoi4d.write_two,
    "hot3d": hot3d.write_two, "oakink2": oakink2.write_two, "taco": taco.write_two,
}  # fmt: skip
NUMBERS = "joints are off by 21 to 37 mm on average and wrists by 6 to 11 mm"


@pytest.mark.parametrize("name", WRITERS)
def test_mano_parameters_converted_with_the_embedded_hand_come_with_a_warning(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    WRITERS[name](tmp_path / "raw")
    summary = convert_dataset(get_adapter(name), tmp_path / "raw", load_embedded_hands(), tmp_path / "store")
    assert summary.clips
    assert NUMBERS in summary.warning
    assert capsys.readouterr().out.startswith(f"warning: {name} has MANO parameters, and the embedded hand is not MANO")
    store = open_store(tmp_path / "store")
    assert NUMBERS in dict(fact_rows(store))["hand model"]
    card = dataset_card(store.folder, store, Format("the store"), for_own_use=True)
    assert f"- Warning: {name} has MANO parameters" in card


def test_generated_files_fitted_hands_and_mano_have_no_warning(tmp_path: Path) -> None:
    """Generated files use the embedded hand, and ManipNet's hands are fitted to the available hand model."""
    arctic.write_two(tmp_path / "raw")
    (tmp_path / "mano").mkdir()
    for model in (load_embedded_hands().left, load_embedded_hands().right):
        write_mano_pickle(model, tmp_path / "mano" / f"MANO_{model.side.upper()}.pkl")
    mano, adapter, raw = load_mano_hands(tmp_path / "mano"), get_adapter("arctic"), tmp_path / "raw"
    summaries = {
        "generated": convert_dataset(
            adapter, raw, load_embedded_hands(), tmp_path / "a", progress=False, synthetic=True
        ),
        "with MANO": convert_dataset(adapter, raw, mano, tmp_path / "b", progress=False),
    }
    assert {name: (summary.clips > 0, summary.warning) for name, summary in summaries.items()} == dict.fromkeys(
        summaries, (True, "")
    )
    facts = {"dataset": "h2o", "synthetic": False, "hand_model": {"name": "embedded"}}
    shapes = {"betas per frame": True, "betas per sequence": True, "personal mesh": True, "fitted": False}
    has_note = {shape: bool(embedded_hand_warning(facts | {"hand_convention": {"shape": shape}})) for shape in shapes}
    assert has_note == shapes


def test_adapters_check_states_the_error_of_the_embedded_hand_for_mano_data() -> None:
    assert NUMBERS in _hands("embedded", needs_mano=True)[1]
    assert _hands("embedded", needs_mano=False)[1] == "hand: embedded"


def test_the_page_of_one_clip_and_the_report_name_the_stand_ins(tmp_path: Path) -> None:
    arctic.write_two(tmp_path / "raw")
    convert_dataset(get_adapter("arctic"), tmp_path / "raw", load_embedded_hands(), tmp_path / "s", progress=False)
    store = open_store(tmp_path / "s")
    page = write_stored_clip(tmp_path, store, store.ids[0], load_embedded_hands())
    assert NUMBERS in page.read_text()

    def section(info: dict, encoder: str) -> SimpleNamespace:
        annotated = SimpleNamespace(annotation_info={"encoder": {"name": encoder}})
        return SimpleNamespace(facts=SimpleNamespace(info=info, annotated=annotated))

    generated = store.info | {"synthetic": True}
    assert [text.split(",")[0] for text in _stand_ins([section(store.info, "use")])] == [
        "arctic has MANO parameters",
        "sentences are encoded by the Universal Sentence Encoder (offline)",
    ]
    assert "hashed words" in _stand_ins([section(generated, "hash")])[0]
    assert _stand_ins([section(generated, "clip")]) == []
