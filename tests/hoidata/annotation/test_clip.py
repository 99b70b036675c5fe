"""CLIP's text tower through open_clip with random weights, and the errors without real weights.

The slow tests need the extra ``hoidata[clip]``; real weights are never needed and nothing is downloaded.
"""

import socket
import threading
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hoidata.annotation import clip_encoder
from hoidata.annotation.clip_encoder import is_reachable, parse_weights_name, read_tower, tagged_weights
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
    weights_name = parse_weights_name(text)
    assert (weights_name.name, weights_name.quick_gelu, weights_name.is_tag) == (name, quick_gelu, is_tag)


def test_a_cached_tag_needs_no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    requests = []

    def cached(repository: str, file: str) -> Path:
        requests.append((repository, file))
        return Path("/cache") / file

    monkeypatch.setattr(clip_encoder, "_cached", cached)
    monkeypatch.setattr(clip_encoder, "is_reachable", lambda *_: pytest.fail("looked"))
    assert tagged_weights(OPEN_CLIP, "openai") == (Path("/cache/open_clip_model.safetensors"), True)
    assert tagged_weights(OPEN_CLIP, "laion2b") == (Path("/cache/weights.safetensors"), False)
    assert requests == [("timm/vit.openai", "open_clip_model.safetensors"), ("laion/vit", "weights.safetensors")]


@pytest.mark.parametrize(("tag", "gelu"), [("openai", "true"), ("laion2b", "false")])
def test_offline_the_remedy_names_the_activation_of_the_tag(monkeypatch: pytest.MonkeyPatch, tag, gelu) -> None:
    pytest.importorskip("huggingface_hub")
    monkeypatch.setattr(clip_encoder, "_cached", lambda *_: None)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    monkeypatch.setattr(clip_encoder, "is_reachable", lambda *_: False)
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
    monkeypatch.setattr(clip_encoder, "getproxies", dict)
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert is_reachable(f"http://127.0.0.1:{port}")
    assert not is_reachable(f"http://127.0.0.1:{port}", within_s=0.3)


@pytest.mark.parametrize("scheme", ["", "http://"])
def test_behind_a_proxy_the_proxy_is_tried(monkeypatch: pytest.MonkeyPatch, scheme: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        proxy = f"{scheme}127.0.0.1:{server.getsockname()[1]}"
        monkeypatch.setattr(clip_encoder, "getproxies", lambda: {"https": proxy})
        assert is_reachable("https://nowhere.invalid")


@pytest.fixture(scope="module")
def towers(tmp_path_factory: pytest.TempPathFactory):
    """Two files of random weights, of ViT-B/32's size and tiny, and what open_clip's own towers of 77 tokens give."""
    import torch
    from safetensors.torch import save_file

    from hoidata.annotation.clip_encoder import ARCHITECTURE, import_open_clip

    open_clip, folder = import_open_clip(), tmp_path_factory.mktemp("clip")
    config = open_clip.get_model_config(ARCHITECTURE)["text_cfg"]
    towers_by_name = {}
    for name, size in {"whole": {}, "tiny": {"width": 64, "heads": 1, "layers": 2}}.items():
        torch.manual_seed(0)
        tower = open_clip.model._build_text_tower(512, {**config, **size}, quick_gelu=True).eval()
        state = {key: value.contiguous() for key, value in tower.state_dict().items()}
        save_file(
            {**state, "visual.proj": torch.zeros(3), "logit_scale": torch.zeros(())}, folder / f"{name}.safetensors"
        )
        with torch.no_grad():
            towers_by_name[name] = (
                folder / f"{name}.safetensors",
                tower(open_clip.get_tokenizer(ARCHITECTURE)(SENTENCES)).numpy(),
            )
    return towers_by_name


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
def test_a_clip_feature_depends_only_on_its_sentence(towers) -> None:
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


def transformers_names(state: dict) -> dict:
    """A tower of open_clip's by the names and shapes that transformers gives a CLIPModel's, with an image tower."""
    import torch

    tensors = {
        "text_projection.weight": state["text_projection"].T,
        "vision_model.embeddings.class_embedding": torch.ones(2),
    }
    tensors |= {"logit_scale": torch.zeros(()), "text_model.embeddings.position_ids": torch.arange(77)[None]}
    tensors["text_model.embeddings.token_embedding.weight"] = state["token_embedding.weight"]
    tensors["text_model.embeddings.position_embedding.weight"] = state["positional_embedding"]
    for kind in ("weight", "bias"):
        tensors[f"text_model.final_layer_norm.{kind}"] = state[f"ln_final.{kind}"]
        for layer in range(sum(name.endswith("ln_1.weight") for name in state)):
            target, source = f"text_model.encoder.layers.{layer}", f"transformer.resblocks.{layer}"
            query, key, value = state[f"{source}.attn.in_proj_{kind}"].chunk(3)
            tensors |= {f"{target}.self_attn.q_proj.{kind}": query, f"{target}.self_attn.k_proj.{kind}": key}
            tensors |= {f"{target}.self_attn.v_proj.{kind}": value}
            tensors[f"{target}.self_attn.out_proj.{kind}"] = state[f"{source}.attn.out_proj.{kind}"]
            tensors[f"{target}.layer_norm1.{kind}"] = state[f"{source}.ln_1.{kind}"]
            tensors[f"{target}.layer_norm2.{kind}"] = state[f"{source}.ln_2.{kind}"]
            tensors[f"{target}.mlp.fc1.{kind}"] = state[f"{source}.mlp.c_fc.{kind}"]
            tensors[f"{target}.mlp.fc2.{kind}"] = state[f"{source}.mlp.c_proj.{kind}"]
    return tensors


def below(prefix: str):
    return lambda state: {prefix + name: tensor for name, tensor in state.items()}


# As transformers' CLIPModel, open_clip's CLIP and CustomTextCLIP, and torch's DistributedDataParallel write them.
NAMINGS = {
    "transformers": transformers_names,
    "transformers, wrapped": lambda state: below("module.")(transformers_names(state)),
    "open_clip's own text tower": below("text."),
    "transformers' text model alone": lambda state: {
        name.removeprefix("text_model."): tensor
        for name, tensor in transformers_names(state).items()
        if not name.startswith("vision")
    },
    "wrapped twice": below("module.text."),
    "OpenAI's": lambda state: state | {"visual.proj": state["ln_final.bias"], "logit_scale": state["ln_final.bias"]},
}


@pytest.fixture(scope="module")
def tiny_tower() -> dict:
    """Random tensors of a tower of two layers and 64 numbers, by open_clip's names."""
    import torch

    draws, layer = torch.Generator().manual_seed(0), "transformer.resblocks"
    shapes = {"token_embedding.weight": (30, 64), "positional_embedding": (77, 64), "text_projection": (64, 512)}
    for kind, rows in (("weight", (64,)), ("bias", ())):
        shapes[f"ln_final.{kind}"] = (64,)
        for number in range(2):
            shapes[f"{layer}.{number}.attn.in_proj_{kind}"] = (192, *rows)
            shapes[f"{layer}.{number}.attn.out_proj.{kind}"] = (64, *rows)
            shapes[f"{layer}.{number}.mlp.c_fc.{kind}"] = (256, *rows)
            shapes[f"{layer}.{number}.mlp.c_proj.{kind}"] = (64, *(256,) * len(rows))
            shapes |= {f"{layer}.{number}.ln_1.{kind}": (64,), f"{layer}.{number}.ln_2.{kind}": (64,)}
    return {name: torch.randn(shape, generator=draws) for name, shape in shapes.items()}


def contiguous(tensors: dict) -> dict:
    return {name: tensor.contiguous().clone() for name, tensor in tensors.items()}


@pytest.mark.parametrize("naming", NAMINGS)
@pytest.mark.parametrize("kind", ["safetensors", "torch", "training"])
def test_a_text_tower_is_read_by_the_names_of_every_library(tiny_tower, naming: str, kind: str, tmp_path: Path) -> None:
    import torch
    from safetensors.torch import save_file

    tensors = contiguous(NAMINGS[naming](tiny_tower))
    if kind == "safetensors":
        save_file(tensors, tmp_path / "weights")
    else:
        torch.save(tensors if kind == "torch" else {"epoch": 3, "state_dict": tensors}, tmp_path / "weights")
    read = read_tower(tmp_path / "weights")
    assert read.keys() == tiny_tower.keys()
    assert all(torch.equal(read[name], tensor) for name, tensor in tiny_tower.items())


def test_half_precision_is_read_as_float32(tiny_tower, tmp_path: Path) -> None:
    import torch

    torch.save({name: tensor.half() for name, tensor in tiny_tower.items()}, tmp_path / "half.pt")
    assert {tensor.dtype for tensor in read_tower(tmp_path / "half.pt").values()} == {torch.float32}


def test_an_incomplete_text_tower_is_refused_with_its_reason(tiny_tower, tmp_path: Path) -> None:
    import zipfile

    import torch

    def refused(tensors: dict, message: str) -> None:
        torch.save(contiguous(tensors), tmp_path / "weights.bin")
        with pytest.raises(BadInput, match=message):
            read_tower(tmp_path / "weights.bin")

    theirs = transformers_names(tiny_tower)
    refused(
        {name: tensor for name, tensor in theirs.items() if name != "text_projection.weight"}, "CLIPTextModelWithProj"
    )
    refused({name: tensor for name, tensor in theirs.items() if "k_proj" not in name}, "q_proj, k_proj and v_proj")
    refused({"bert.encoder.weight": torch.ones(1)}, "names of open_clip, OpenAI or transformers, got tensors bert.enc")
    refused(tiny_tower | below("text.")(tiny_tower), "got 2 towers")
    for name in ("archive/data.pkl", "archive/constants.pkl"):
        with zipfile.ZipFile(tmp_path / "script.pt", "a") as archive:
            archive.writestr(name, "")
    with pytest.raises(BadInput, match="a TorchScript archive, which holds code; write the weights' state_dict"):
        read_tower(tmp_path / "script.pt")
    torch.save(contiguous(tiny_tower), tmp_path / "old.pt", _use_new_zipfile_serialization=False)
    with pytest.raises(BadInput, match=r"a safetensors file, or a zip file of torch\.save"):
        read_tower(tmp_path / "old.pt")
    (tmp_path / "cut.pt").write_bytes((tmp_path / "weights.bin").read_bytes()[:3000])
    with pytest.raises(BadInput, match=r"cut\.pt"):
        read_tower(tmp_path / "cut.pt")


@pytest.mark.slow
@needs_open_clip
def test_weights_by_transformers_names_give_the_same_features(towers, tmp_path: Path) -> None:
    from safetensors.torch import load_file, save_file

    path, expected = towers["tiny"]
    save_file(contiguous(transformers_names(load_file(path))), tmp_path / "model.safetensors")
    encoder = load_encoder(f"clip:{tmp_path / 'model.safetensors'}")
    np.testing.assert_allclose(encoder.encode(SENTENCES), expected, atol=1e-5)
