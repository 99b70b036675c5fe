"""Writes a clip as an animated GLB for any glTF 2.0 viewer.

Hands are skinned meshes on MANO's 16 joints. Their shape (mean betas of the valid frames, or the personal template) is
baked into the rest mesh. glTF skins cannot represent pose correctives and more than four joint weights per vertex, so
these are dropped; the embedded hand has correctives of up to 1.5 mm, and at most four weights. A hand without valid
frames is not in the file, and a hand is scaled to zero in invalid frames. The node "world" rotates gravity to -y.
"""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
import pygltflib as gltf
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import FPS, SIDES, Clip, HandTrack, ObjectTrack, Side
from hoidata.hands import JOINT_NAMES, HandModel, HandPair
from hoidata.hands.embedded import vertex_normals
from hoidata.objects.model import ObjectModel
from pipelines.pages.surface import ContactPaint, Surface, display_surface

Colour = tuple[float, float, float]
_TYPES = {1: gltf.SCALAR, 3: gltf.VEC3, 4: gltf.VEC4, 16: gltf.MAT4}
_COMPONENTS = {"float32": gltf.FLOAT, "uint8": gltf.UNSIGNED_BYTE, "uint32": gltf.UNSIGNED_INT}
HAND_COLOURS = {"left": (0.47, 0.62, 0.78), "right": (0.90, 0.69, 0.53)}
GHOST_COLOUR, GHOST_OPACITY = (0.35, 0.62, 0.42), 0.38
OBJECT_COLOUR = (0.84, 0.83, 0.80)
MOVING_PART_COLOUR = (0.72, 0.74, 0.74)
OTHER_OBJECT_COLOUR = (0.71, 0.66, 0.58)
CONTACT_COLOURS = ((0.0, OBJECT_COLOUR), (0.5, (0.95, 0.62, 0.25)), (1.0, (0.78, 0.12, 0.14)))


class GltfBuilder:
    """A glTF 2.0 document under construction: collects arrays and nodes; equal calls give equal bytes."""

    def __init__(self, title: str, extras: dict | None = None) -> None:
        self.document = gltf.GLTF2(asset=gltf.Asset(version="2.0", generator="hoidata", extras=extras or {}))
        self.document.scenes = [gltf.Scene(name=title, nodes=[])]
        self.document.scene = 0
        self._animation = gltf.Animation(name="motion")
        self._chunks: list[bytes] = []
        self._offset = 0

    def array(
        self, values: np.ndarray, target: int | None = None, bounds: bool = False, normalized: bool = False
    ) -> int:
        """Add ``values`` (item,) or (item, component), float32, uint8 or uint32; returns the accessor's index."""
        values = np.ascontiguousarray(values)
        data = values.tobytes()
        view = gltf.BufferView(buffer=0, byteOffset=self._offset, byteLength=len(data), target=target)
        self.document.bufferViews.append(view)
        padded = data + b"\0" * (-len(data) % 4)
        self._chunks.append(padded)
        self._offset += len(padded)
        flat = values.reshape(len(values), -1)
        accessor = gltf.Accessor(
            bufferView=len(self.document.bufferViews) - 1,
            componentType=_COMPONENTS[values.dtype.name],
            count=len(values),
            type=_TYPES[flat.shape[1]],
            normalized=normalized,
        )
        if bounds:
            accessor.min, accessor.max = flat.min(axis=0).tolist(), flat.max(axis=0).tolist()
        self.document.accessors.append(accessor)
        return len(self.document.accessors) - 1

    def node(self, name: str, parent: int | None, **properties: object) -> int:
        """Add a node below ``parent`` (None: the scene's root); properties as in glTF (translation, mesh, skin...)."""
        self.document.nodes.append(gltf.Node(name=name, **properties))  # pyright: ignore[reportArgumentType]
        index = len(self.document.nodes) - 1
        siblings = self.document.scenes[0].nodes if parent is None else self.document.nodes[parent].children
        assert siblings is not None
        siblings.append(index)
        return index

    def mesh(
        self, name: str, attributes: dict[str, int], faces: np.ndarray, colour: Colour, opacity: float = 1.0
    ) -> int:
        """Add a mesh with faces (face, 3) and a matt material of its name; colour as sRGB numbers in [0, 1]."""
        indices = self.array(faces.reshape(-1).astype(np.uint32), gltf.ELEMENT_ARRAY_BUFFER)
        factor = [*linear_from_srgb(np.array(colour)).round(5).tolist(), opacity]
        surface = gltf.PbrMetallicRoughness(baseColorFactor=factor, metallicFactor=0.0, roughnessFactor=0.75)
        material = gltf.Material(name=name, pbrMetallicRoughness=surface, alphaCutoff=None)
        if opacity < 1:
            material.alphaMode = gltf.BLEND
        self.document.materials.append(material)
        number = len(self.document.materials) - 1
        primitive = gltf.Primitive(attributes=gltf.Attributes(**attributes), indices=indices, material=number)
        self.document.meshes.append(gltf.Mesh(name=name, primitives=[primitive]))
        return len(self.document.meshes) - 1

    def skin(self, name: str, joints: list[int], inverse_bind: np.ndarray) -> int:
        """Add a skin; inverse_bind: (joint, 4, 4) acting on column vectors (glTF stores them column by column)."""
        matrices = self.array(inverse_bind.transpose(0, 2, 1).reshape(-1, 16).astype(np.float32))
        skin = gltf.Skin(name=name, joints=joints, skeleton=joints[0], inverseBindMatrices=matrices)
        self.document.skins.append(skin)
        return len(self.document.skins) - 1

    def animate(self, node: int, path: str, times: int, values: np.ndarray, step: bool = False) -> None:
        """Animate one property ("translation", "rotation" as xyzw, "scale") of a node; times: accessor of seconds."""
        output, kind = self.array(values.astype(np.float32)), gltf.ANIM_STEP if step else gltf.ANIM_LINEAR
        self._animation.samplers.append(gltf.AnimationSampler(input=times, output=output, interpolation=kind))
        target = gltf.AnimationChannelTarget(node=node, path=path)
        self._animation.channels.append(gltf.AnimationChannel(sampler=len(self._animation.samplers) - 1, target=target))

    def to_bytes(self) -> bytes:
        """The finished GLB."""
        self.document.animations = [self._animation] if self._animation.channels else []
        data = b"".join(self._chunks)
        self.document.buffers = [gltf.Buffer(byteLength=len(data))]
        self.document.set_binary_blob(data)
        return b"".join(self.document.save_to_bytes())


def glb_bytes(
    clip: Clip,
    hands: HandPair | None,
    contact: ContactPaint | None = None,
    ghosts: Mapping[Side, HandTrack] = MappingProxyType({}),
    extras: dict | None = None,
    markers: Mapping[Side, np.ndarray] = MappingProxyType({}),
) -> bytes:
    """``clip`` as an animated, self-contained GLB; equal inputs give equal bytes.

    Args:
        hands: None for the objects alone.
        ghosts: transparent hands, for comparison with those of the clip.
        markers: per side (frame, 21, 3) world joints, metres, added as empty nodes ``<side> joint <name>``.
    """
    facts = {"clip": clip.clip_id, "synthetic": clip.synthetic, "fps": FPS}
    builder = GltfBuilder(clip.clip_id, facts | (extras or {}))
    world = builder.node("world", None, rotation=upright_rotation(clip.gravity).as_quat().round(9).tolist())
    times = builder.array((np.arange(clip.n_frames) / FPS).astype(np.float32), bounds=True)
    _add_object(builder, world, times, "object", clip.object, contact)
    for number, track in enumerate(clip.other_objects):
        _add_object(builder, world, times, f"other object {number}", track, None)
    for side in SIDES:
        if hands is not None and clip.hands[side].valid.any():
            _add_hand(builder, world, times, hands[side], clip.hands[side])
    for side, track in ghosts.items():
        if hands is not None and track.valid.any():
            _add_hand(builder, world, times, hands[side], track, is_ghost=True)
    for side, joints_m in markers.items():
        for number, name in enumerate(JOINT_NAMES):
            builder.animate(builder.node(f"{side} joint {name}", world), "translation", times, joints_m[:, number])
    return builder.to_bytes()


def upright_rotation(gravity: np.ndarray | None) -> Rotation:
    """The smallest rotation from ``gravity`` to -y; identity if gravity is unknown."""
    if gravity is None:
        return Rotation.identity()
    down, target = np.asarray(gravity, dtype=np.float64), np.array((0.0, -1.0, 0.0))
    axis, cosine = np.cross(down, target), float(down @ target)
    if np.linalg.norm(axis) < 1e-9:
        return Rotation.identity() if cosine > 0 else Rotation.from_rotvec((np.pi, 0.0, 0.0))
    return Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.arccos(np.clip(cosine, -1, 1)))


def contact_colours(value: np.ndarray) -> np.ndarray:
    """Contact values (vertex,) in [0, 1] to linear RGBA (vertex, 4) uint8: object grey, orange, red."""
    stops = np.array([stop for stop, _ in CONTACT_COLOURS])
    colours = np.array([colour for _, colour in CONTACT_COLOURS])
    srgb = np.stack([np.interp(value, stops, colours[:, channel]) for channel in range(3)], axis=1)
    rgba = np.concatenate([linear_from_srgb(srgb), np.ones((len(value), 1))], axis=1)
    return np.round(rgba * 255).astype(np.uint8)


def rest_hand(model: HandModel, track: HandTrack) -> tuple[np.ndarray, np.ndarray]:
    """Shaped rest vertices (778, 3) and joints (16, 3), metres, of one hand: mean betas over its valid frames."""
    template = model.template_m if track.template_m is None else track.template_m
    vertices = np.asarray(template, dtype=np.float64) + model.shape_directions @ track.mean_betas
    return vertices, model.joint_regressor @ vertices


def strongest_weights(skin_weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The four strongest joints of each vertex, (vertex, 4) uint8, and their weights (vertex, 4) float32, sum 1."""
    joints = np.argsort(-skin_weights, axis=1, kind="stable")[:, :4]
    weights = np.take_along_axis(skin_weights, joints, axis=1)
    weights = weights / weights.sum(axis=1, keepdims=True)
    return np.where(weights > 0, joints, 0).astype(np.uint8), weights.astype(np.float32)


def _add_hand(
    builder: GltfBuilder, world: int, times: int, model: HandModel, track: HandTrack, is_ghost: bool = False
) -> None:
    name = f"{'recorded ' * is_ghost}{model.side}"
    colour, opacity = (GHOST_COLOUR, GHOST_OPACITY) if is_ghost else (HAND_COLOURS[model.side], 1.0)
    vertices, rest_joints = rest_hand(model, track)
    nodes = _add_skeleton(builder, world, model, rest_joints, name)
    inverse_bind = np.tile(np.eye(4), (16, 1, 1))
    inverse_bind[:, :3, 3] = -rest_joints
    skin = builder.skin(f"{name} skin", nodes, inverse_bind)
    joints, weights = strongest_weights(np.asarray(model.skin_weights))
    faces = np.asarray(model.faces, dtype=np.int64)
    attributes = {
        **_surface_attributes(builder, Surface(vertices, vertex_normals(vertices, faces), faces), np.zeros(3)),
        "JOINTS_0": builder.array(joints, gltf.ARRAY_BUFFER),
        "WEIGHTS_0": builder.array(weights, gltf.ARRAY_BUFFER),
    }
    mesh = builder.mesh(f"{name} hand", attributes, faces, colour, opacity)
    builder.node(f"{name} hand", None, mesh=mesh, skin=skin)
    _animate_hand(builder, times, nodes, track)


def _add_skeleton(
    builder: GltfBuilder, world: int, model: HandModel, rest_joints: np.ndarray, hand_name: str
) -> list[int]:
    offsets = np.concatenate([rest_joints[:1], rest_joints[1:] - rest_joints[model.parents[1:]]]).astype(np.float32)
    nodes: list[int] = []
    for joint, name in enumerate(JOINT_NAMES[:16]):
        parent = nodes[model.parents[joint]] if joint else world
        nodes.append(builder.node(f"{hand_name} {name}", parent, translation=offsets[joint].tolist()))
    return nodes


def _animate_hand(builder: GltfBuilder, times: int, nodes: list[int], track: HandTrack) -> None:
    pose = np.concatenate([track.global_orient, track.hand_pose], axis=1).reshape(track.n_frames, 16, 3)
    builder.animate(nodes[0], "translation", times, track.wrist_m)
    for joint, node in enumerate(nodes):
        builder.animate(node, "rotation", times, continuous_quaternions(pose[:, joint]))
    if not track.valid.all():
        scale = np.repeat(track.valid[:, None].astype(np.float32), 3, axis=1)
        builder.animate(nodes[0], "scale", times, scale, step=True)


def _add_object(
    builder: GltfBuilder, world: int, times: int, name: str, track: ObjectTrack, contact: ContactPaint | None
) -> None:
    model = track.model
    colours = (OBJECT_COLOUR, MOVING_PART_COLOUR) if name == "object" else (OTHER_OBJECT_COLOUR, OTHER_OBJECT_COLOUR)
    node = builder.node(name, world)
    builder.animate(node, "translation", times, track.translation_m)
    builder.animate(node, "rotation", times, continuous_quaternions(track.rotvec))
    _add_part(builder, node, model, 0, colours[0], contact)
    if model.hinge is None or track.hinge_rad is None:
        return
    part = builder.node(f"{name} moving part", node, translation=np.float32(model.hinge.origin_m).tolist())
    positions_m, angles = model.hinge.node_motion(track.hinge_rad)
    if model.hinge.is_prismatic:
        builder.animate(part, "translation", times, positions_m.astype(np.float32))
    else:
        builder.animate(part, "rotation", times, continuous_quaternions(angles))
    _add_part(builder, part, model, 1, colours[1], contact)


def _add_part(
    builder: GltfBuilder, parent: int, model: ObjectModel, part: int, colour: Colour, contact: ContactPaint | None
) -> None:
    """Attach one rigid part of the object to its node; vertices of the moving part are relative to the hinge origin."""
    vertices_m, faces = model.part_mesh(part)
    if not len(faces):
        return
    if contact is not None:
        here = np.asarray(contact.part) == part
        contact = ContactPaint(contact.points_m[here], contact.part[here], contact.value[here])
    surface = display_surface(vertices_m, faces, contact)
    origin = model.hinge.origin_m if part == 1 and model.hinge is not None else np.zeros(3)
    attributes = _surface_attributes(builder, surface, origin)
    # A painted surface carries its colour per vertex; the material then only says how it shines.
    colour = colour if surface.value is None else (1.0, 1.0, 1.0)
    mesh = builder.mesh(f"{model.name} {part}", attributes, surface.faces, colour)
    builder.node(f"{model.name} {'base' if part == 0 else 'part'} mesh", parent, mesh=mesh)


def _surface_attributes(builder: GltfBuilder, surface: Surface, origin: np.ndarray) -> dict[str, int]:
    attributes = {
        "POSITION": builder.array((surface.vertices_m - origin).astype(np.float32), gltf.ARRAY_BUFFER, bounds=True),
        "NORMAL": builder.array(surface.normals.astype(np.float32), gltf.ARRAY_BUFFER),
    }
    if surface.value is not None:
        attributes["COLOR_0"] = builder.array(contact_colours(surface.value), gltf.ARRAY_BUFFER, normalized=True)
    return attributes


def continuous_quaternions(rotvec: np.ndarray) -> np.ndarray:
    """Axis-angle (frame, 3) to xyzw quaternions (frame, 4) whose sign never flips between frames."""
    quaternions = Rotation.from_rotvec(np.asarray(rotvec, dtype=np.float64)).as_quat()
    flips = np.einsum("ij,ij->i", quaternions[1:], quaternions[:-1]) < 0
    signs = np.cumprod(np.concatenate([[1.0], np.where(flips, -1.0, 1.0)]))
    return quaternions * signs[:, None]


def linear_from_srgb(colour: np.ndarray) -> np.ndarray:
    """sRGB in [0, 1] to linear light (IEC 61966-2-1), the colour space of glTF."""
    return np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)
