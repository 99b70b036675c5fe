"""CLIP's text tower through open_clip with random weights, and what is said where real weights are not there.

The slow tests need the extra ``hoidata[clip]``; real weights are never needed and nothing is downloaded.
"""

import socket
import threading
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hoidata.annotation import clip_weights
from hoidata.annotation.clip_weights import is_reachable, parse_weights_name, tagged_weights
from hoidata.annotation.encoders import load_encoder
from hoidata.errors import BadInput, MissingResource

SENTENCES = ["Lift a box with the left hand.", "Pour milk with both hands.", "A mug is grabbed by the right hand."]
needs_open_clip = pytest.mark.skipif(find_spec("open_clip") is None, reason="hoidata[clip] is not installed")
OPEN_CLIP = SimpleNamespace(
    list_pretrained_tags_by_model=lambda _: ["openai", "laion2b", "old"],
    get_pretrained_cfg=lambda _, tag: {
        "openai": {"hf_hub": "timm/vit.openai/", "quick_gelu": True},
        "laion2b": {"hf_hub": "laion/vit/weights.bin"},
        "old": {"url": "https://example.com/a.pt"},
    }.get(tag, {}),
)


@pytest.mark.parametrize(
    ("text", "name", "quick_gelu", "is_tag"),
    [
        ("/a/b.safetensors", "/a/b.safetensors", True, False),
        ("b.safetensors?quick_gelu=false", "b.safetensors", False, False),
        ("openai", "openai", None, True),
        ("laion2b_s34b_b79k", "laion2b_s34b_b79k", None, True),
    ],
)
def test_a_name_is_a_tag_or_a_file_with_its_activation(text, name, quick_gelu, is_tag) -> None:
    found = parse_weights_name(text)
    assert (found.name, found.quick_gelu, found.is_tag) == (name, quick_gelu, is_tag)


def test_a_tag_on_this_machine_is_taken_without_a_look_at_the_network(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def cached(repository: str, file: str) -> Path:
        asked.append((repository, file))
        return Path("/cache") / file

    monkeypatch.setattr(clip_weights, "_cached", cached)
    monkeypatch.setattr(clip_weights, "is_reachable", lambda *_: pytest.fail("looked"))
    assert tagged_weights(OPEN_CLIP, "openai") == (Path("/cache/open_clip_model.safetensors"), True)
    assert tagged_weights(OPEN_CLIP, "laion2b") == (Path("/cache/weights.safetensors"), False)
    assert asked == [("timm/vit.openai", "open_clip_model.safetensors"), ("laion/vit", "weights.safetensors")]


@pytest.mark.parametrize(("tag", "gelu"), [("openai", "true"), ("laion2b", "false")])
def test_offline_the_way_out_is_named_with_the_tags_own_activation(monkeypatch: pytest.MonkeyPatch, tag, gelu) -> None:
    pytest.importorskip("huggingface_hub")
    monkeypatch.setattr(clip_weights, "_cached", lambda *_: None)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    monkeypatch.setattr(clip_weights, "is_reachable", lambda *_: False)
    with pytest.raises(MissingResource, match=rf"cannot be reached.*quick_gelu={gelu}.*annotate\.encoder: use"):
        tagged_weights(OPEN_CLIP, tag)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    with pytest.raises(MissingResource, match="HF_HUB_OFFLINE"):
        tagged_weights(OPEN_CLIP, tag)


@pytest.mark.parametrize("tag", ["open_ai", "old"])
def test_a_tag_without_safetensors_weights_is_refused_and_the_others_listed(tag: str) -> None:
    with pytest.raises(BadInput, match="openai, laion2b, got"):
        tagged_weights(OPEN_CLIP, tag)


def test_a_silent_name_server_costs_no_more_than_the_time_given(monkeypatch: pytest.MonkeyPatch) -> None:
    given_up = threading.Event()

    def silent(*_, **__) -> None:
        given_up.wait(60)
        raise OSError

    monkeypatch.setattr(socket, "create_connection", silent)
    assert not is_reachable("https://huggingface.co", within_s=0.2)
    given_up.set()  # it did not wait for the answer


def test_a_listening_address_is_reachable_and_a_closed_port_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clip_weights, "getproxies", dict)
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert is_reachable(f"http://127.0.0.1:{port}")
    assert not is_reachable(f"http://127.0.0.1:{port}", within_s=0.3)


@pytest.mark.parametrize("scheme", ["", "http://"])
def test_behind_a_proxy_it_is_the_proxy_that_is_asked(monkeypatch: pytest.MonkeyPatch, scheme: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        proxy = f"{scheme}127.0.0.1:{server.getsockname()[1]}"
        monkeypatch.setattr(clip_weights, "getproxies", lambda: {"https": proxy})
        assert is_reachable("https://nowhere.invalid")


@pytest.fixture(scope="module")
def towers(tmp_path_factory: pytest.TempPathFactory):
    """Two files of random weights, of ViT-B/32's size and tiny, and what open_clip's own towers of 77 tokens give."""
    import torch
    from safetensors.torch import save_file

    from hoidata.annotation.clip_encoder import ARCHITECTURE, import_open_clip

    open_clip, folder = import_open_clip(), tmp_path_factory.mktemp("clip")
    config = open_clip.get_model_config(ARCHITECTURE)["text_cfg"]
    made = {}
    for name, size in {"whole": {}, "tiny": {"width": 64, "heads": 1, "layers": 2}}.items():
        torch.manual_seed(0)
        tower = open_clip.model._build_text_tower(512, {**config, **size}, quick_gelu=True).eval()
        state = {key: value.contiguous() for key, value in tower.state_dict().items()}
        save_file(
            {**state, "visual.proj": torch.zeros(3), "logit_scale": torch.zeros(())}, folder / f"{name}.safetensors"
        )
        with torch.no_grad():
            made[name] = folder / f"{name}.safetensors", tower(open_clip.get_tokenizer(ARCHITECTURE)(SENTENCES)).numpy()
    return made


@pytest.mark.slow
@needs_open_clip
@pytest.mark.parametrize(("size", "name"), [("whole", "clip-ViT-B-32"), ("tiny", "clip-text-64x2")])
def test_the_short_tower_equals_open_clips_whole_one(towers, size: str, name: str) -> None:
    path, expected = towers[size]
    encoder = load_encoder(f"clip:{path}")
    np.testing.assert_allclose(encoder.encode(SENTENCES), expected, atol=1e-5)
    assert (encoder.identity["name"], encoder.identity["quick_gelu"]) == (name, True)
    plain = load_encoder(f"clip:{path}?quick_gelu=false")
    assert plain.identity != encoder.identity
    assert np.abs(plain.encode(SENTENCES) - expected).max() > 1e-4


@pytest.mark.slow
@needs_open_clip
def test_a_clip_feature_depends_on_its_own_sentence_alone(towers) -> None:
    import torch

    path, _ = towers["whole"]
    together = load_encoder(f"clip:{path}").encode(SENTENCES)
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    alone = load_encoder(f"clip:{path}").encode(SENTENCES[1:2])
    torch.set_num_threads(threads)
    assert alone[0].tobytes() == together[1].tobytes()
    assert load_encoder(f"clip:{path}").encode([]).shape == (0, 512)


@pytest.mark.slow
@needs_open_clip
def test_other_weights_are_refused(tmp_path: Path) -> None:
    import torch
    from safetensors.torch import save_file

    save_file({"text_projection": torch.zeros(768, 768)}, tmp_path / "large.safetensors")
    save_file({"text_projection": torch.zeros(64, 512)}, tmp_path / "parts.safetensors")
    (tmp_path / "text.safetensors").write_text("no weights")
    for name in ("large", "parts", "text"):
        with pytest.raises(BadInput, match=f"{name}.safetensors"):
            load_encoder(f"clip:{tmp_path / name}.safetensors")
