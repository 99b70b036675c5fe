"""Fixtures of the page tests: a synthetic clip (hands at a carried box) and an independent glTF reader."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pygltflib
import pytest
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import Clip, HandTrack, ObjectTrack, Side
from hoidata.hands import load_embedded_hands
from hoidata.objects.model import ObjectModel
from tests.builders.clips import clip_of
from tests.builders.objects import box_model, two_parts

FRAMES = 24


def hand_track(wrist_m: np.ndarray, orient: np.ndarray, valid: bool, curl_rad: float = 0.9) -> HandTrack:
    frames = len(wrist_m)
    pose = np.zeros((frames, 15, 3))
    pose[:, :12, 2] = np.linspace(0.1, curl_rad, frames)[:, None]
    betas = np.linspace(-1, 1, 10)[None]
    return HandTrack(wrist_m, orient, pose.reshape(frames, 45), betas, valid=np.full(frames, valid))


def page_model(hinged: bool = False) -> ObjectModel:
    box = box_model((0.08, 0.12, 0.06))
    lid = box_model((0.08, 0.12, 0.01), middle_m=(0, 0, 0.036))
    return two_parts(box, lid, (0, 1, 0), (-0.04, 0, 0.031), "lidded box") if hinged else box


def make_page_clip(right: bool = True, left: bool = False, hinged: bool = False, frames: int = FRAMES) -> Clip:
    """A box lifted from z = 0 by 20 cm while it turns; hands follow at its sides; gravity along -z."""
    phase = np.linspace(0, 1, frames)
    centre = np.stack([0.1 * phase, 0.05 * phase, 0.03 + 0.2 * phase], axis=1)
    rotvec = np.stack([0 * phase, 0 * phase, 0.6 * phase], axis=1)
    hinge = -1.2 * phase if hinged else None
    tracks: dict[Side, HandTrack] = {
        "left": hand_track(centre + np.array((-0.13, 0, 0.08)), np.tile((1.3, -0.2, -2.6), (frames, 1)), left),
        "right": hand_track(centre + np.array((0.13, 0, 0.08)), np.tile((1.3, 0.2, 2.6), (frames, 1)), right),
    }
    track = ObjectTrack(page_model(hinged), rotvec, centre, hinge)
    return replace(clip_of("test/s1/box_lift", track, tracks, object_words="box"), clip_id="test/box_lift")


_DTYPES = {5121: np.uint8, 5125: np.uint32, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class GltfFile:
    def __init__(self, path: Path) -> None:
        self.document = pygltflib.GLTF2().load_binary(str(path))
        self.blob = self.document.binary_blob()

    def array(self, index: int) -> np.ndarray:
        accessor = self.document.accessors[index]
        view = self.document.bufferViews[accessor.bufferView]
        width, dtype = _WIDTHS[accessor.type], _DTYPES[accessor.componentType]
        flat = np.frombuffer(self.blob, dtype, accessor.count * width, view.byteOffset)
        return flat.reshape(accessor.count, width)

    def node_names(self) -> list[str]:
        return [node.name for node in self.document.nodes]

    def node(self, name: str) -> int:
        return self.node_names().index(name)

    def world_matrix(self, node: int, frame: int, world: bool = True) -> np.ndarray:
        """4x4 of ``node`` at ``frame``; with world False the root "world" counts as the identity."""
        parents = {child: index for index, item in enumerate(self.document.nodes) for child in item.children}
        matrix = self._local_matrix(node, frame)
        while node in parents:
            node = parents[node]
            if world or self.document.nodes[node].name != "world":
                matrix = self._local_matrix(node, frame) @ matrix
        return matrix

    def skinned(self, name: str, frame: int) -> np.ndarray:
        """Vertices of a skinned node at a frame, in the clip's own world frame."""
        item = self.document.nodes[self.node(name)]
        skin = self.document.skins[item.skin]
        inverse_bind = self.array(skin.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)
        bones = np.stack([self.world_matrix(joint, frame, world=False) for joint in skin.joints]) @ inverse_bind
        attributes = self.document.meshes[item.mesh].primitives[0].attributes
        homogeneous = np.c_[
            self.array(attributes.POSITION), np.ones(self.document.accessors[attributes.POSITION].count)
        ]
        joints, weights = self.array(attributes.JOINTS_0), self.array(attributes.WEIGHTS_0)
        return np.einsum("vk,vkij,vj->vi", weights, bones[joints], homogeneous)[:, :3]

    def placed(self, name: str, frame: int) -> np.ndarray:
        """Vertices of a rigid mesh node at a frame, in the clip's own world frame."""
        node = self.node(name)
        attributes = self.document.meshes[self.document.nodes[node].mesh].primitives[0].attributes
        matrix = self.world_matrix(node, frame, world=False)
        return self.array(attributes.POSITION) @ matrix[:3, :3].T + matrix[:3, 3]

    def _local_matrix(self, node: int, frame: int) -> np.ndarray:
        item = self.document.nodes[node]
        values = {"translation": item.translation, "rotation": item.rotation, "scale": item.scale}
        for channel in self.document.animations[0].channels:
            if channel.target.node == node:
                sampler = self.document.animations[0].samplers[channel.sampler]
                values[channel.target.path] = self.array(sampler.output)[frame]
        matrix = np.eye(4)
        scale = np.ones(3) if values["scale"] is None else np.asarray(values["scale"])
        rotation = (0, 0, 0, 1) if values["rotation"] is None else values["rotation"]
        matrix[:3, :3] = Rotation.from_quat(rotation).as_matrix() * scale
        matrix[:3, 3] = 0 if values["translation"] is None else values["translation"]
        return matrix


@pytest.fixture(scope="session")
def hands():
    return load_embedded_hands()


@pytest.fixture(scope="session")
def page_clip():
    return make_page_clip


@pytest.fixture
def read_glb():
    return GltfFile


@pytest.fixture
def chromium() -> list[str]:
    """The browser and what makes it open a page without a window."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no chromium on PATH: the page was not opened")
    drawing = ("--disable-gpu", "--enable-unsafe-swiftshader", "--use-angle=swiftshader")
    return [browser, "--headless", "--no-sandbox", *drawing, "--no-first-run"]
