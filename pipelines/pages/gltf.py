"""A glTF 2.0 document under construction: typed arrays, nodes, skins and one animation, then one GLB."""

import numpy as np
import pygltflib as gltf

_TYPES = {1: gltf.SCALAR, 3: gltf.VEC3, 4: gltf.VEC4, 16: gltf.MAT4}
_COMPONENTS = {"float32": gltf.FLOAT, "uint8": gltf.UNSIGNED_BYTE, "uint32": gltf.UNSIGNED_INT}


class GltfBuilder:
    """Collects arrays and nodes; equal calls give equal bytes."""

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
        """Add ``values`` (item,) or (item, component), float32, uint8 or uint32; give the accessor's index."""
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

    def material(
        self, name: str, colour: tuple[float, float, float], roughness: float = 0.75, opacity: float = 1.0
    ) -> int:
        """Matt material; colour as sRGB numbers in [0, 1]."""
        surface = gltf.PbrMetallicRoughness(
            baseColorFactor=[*linear_from_srgb(np.array(colour)).round(5).tolist(), opacity],
            metallicFactor=0.0,
            roughnessFactor=roughness,
        )
        material = gltf.Material(name=name, pbrMetallicRoughness=surface, alphaCutoff=None)
        if opacity < 1:
            material.alphaMode = gltf.BLEND
        self.document.materials.append(material)
        return len(self.document.materials) - 1

    def mesh(self, name: str, attributes: dict[str, int], indices: int, material: int) -> int:
        primitive = gltf.Primitive(attributes=gltf.Attributes(**attributes), indices=indices, material=material)
        self.document.meshes.append(gltf.Mesh(name=name, primitives=[primitive]))
        return len(self.document.meshes) - 1

    def skin(self, name: str, joints: list[int], inverse_bind: np.ndarray) -> int:
        """Add a skin; inverse_bind: (joint, 4, 4) acting on column vectors (glTF stores them column by column)."""
        matrices = inverse_bind.transpose(0, 2, 1).reshape(-1, 16).astype(np.float32)
        self.document.skins.append(
            gltf.Skin(name=name, joints=joints, skeleton=joints[0], inverseBindMatrices=self.array(matrices))
        )
        return len(self.document.skins) - 1

    def animate(self, node: int, path: str, times: int, values: np.ndarray, step: bool = False) -> None:
        """Animate one property ("translation", "rotation" as xyzw, "scale") of a node; times: accessor of seconds."""
        sampler = gltf.AnimationSampler(
            input=times,
            output=self.array(values.astype(np.float32)),
            interpolation=gltf.ANIM_STEP if step else gltf.ANIM_LINEAR,
        )
        self._animation.samplers.append(sampler)
        target = gltf.AnimationChannelTarget(node=node, path=path)
        self._animation.channels.append(gltf.AnimationChannel(sampler=len(self._animation.samplers) - 1, target=target))

    def to_bytes(self) -> bytes:
        """The finished GLB."""
        self.document.animations = [self._animation] if self._animation.channels else []
        data = b"".join(self._chunks)
        self.document.buffers = [gltf.Buffer(byteLength=len(data))]
        self.document.set_binary_blob(data)
        return b"".join(self.document.save_to_bytes())


def linear_from_srgb(colour: np.ndarray) -> np.ndarray:
    """sRGB in [0, 1] to linear light (IEC 61966-2-1), as glTF wants its colours."""
    return np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)
