"""Plots for docs/concepts from the data of `make demo`: `python -m docs.make.drawings PROJECT`."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from hoidata.annotation.sentences import FORMS
from hoidata.clips.clip import SIDES, HandTrack
from hoidata.dataset_folders import built_in_names, dataset_facts, dataset_title
from hoidata.datasets.registry import get_adapter
from hoidata.hands import load_embedded_hands
from hoidata.hands.kinematics import track_vertices
from hoidata.store.annotated import load_annotated
from hoidata.surface.measure import measure_hand
from pipelines.lineage.graph import written_graph

IMAGES = Path(__file__).parents[1] / "images"
BLUE, SAND, GREY, RED, GREEN = "#7a9fc6", "#e6b087", "#d6d4cc", "#c4571b", "#7f9c6c"
COLOURS = {"left": BLUE, "right": SAND}
CLIP = "grab/s10/mug_drink_1"
TOUCH = matplotlib.colors.LinearSegmentedColormap.from_list("touch", ["#d6d4cc", "#f29e40", "#c71f24"])
SUBSET_COLOURS = {"train": "#9fb8d3", "validation": "#e9c46a", "test": "#c4571b", "excluded": "#eeeeee"}
HANDS = load_embedded_hands()


def mesh(axes, vertices: np.ndarray, faces: np.ndarray, colour, opacity: float = 1.0) -> None:
    """Draw a shaded mesh.

    Args:
        axes: 3D axes.
        vertices: (vertex, 3), metres.
        faces: (face, 3) indices.
        colour: one colour, or (face, 3).
        opacity: 0 to 1.
    """
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12
    light = 0.62 + 0.38 * np.abs(normals @ np.array((0.35, -0.5, 0.79)))
    rgb = np.atleast_2d(matplotlib.colors.to_rgba_array(colour))[:, :3]
    axes.add_collection3d(Poly3DCollection(corners, facecolors=np.clip(rgb * light[:, None], 0, 1), alpha=opacity))


def frame_of(axes, centre: np.ndarray, radius: float, view: tuple[float, float] = (18, -60)) -> None:
    """Set limits and view of 3D axes, and hide their box."""
    for set_limits, middle in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), centre, strict=True):
        set_limits(middle - radius, middle + radius)
    axes.set_box_aspect((1, 1, 1), zoom=1.5)
    axes.view_init(*view)
    axes.set_axis_off()


def triad(
    axes, origin: np.ndarray, length: float, names: tuple[str, ...] = ("x", "y", "z"), up: int | None = 2
) -> None:
    """Draw three coordinate axes, with the up axis in bold."""
    for number, name in enumerate(names):
        tip = origin + length * np.eye(3)[number]
        bold = number == up
        axes.plot(*np.stack([origin, tip]).T, color=RED if bold else "#555555", linewidth=2.4 if bold else 1.1)
        axes.text(*(tip + 0.12 * (tip - origin)), f"{name}, up" if bold else name, fontsize=8, color="#333333")


def hand_vertices(side: str, track, frame: int) -> np.ndarray:
    """(778, 3) world vertices of one hand in one frame, metres."""
    return track_vertices(track.take(slice(frame, frame + 1)), HANDS[side])[0]


def draw_clip(figure: Figure, data: Path) -> None:
    """Plot four frames of one clip in the source's world."""
    clip = load_annotated(data / "grab", HANDS).clip(CLIP)
    for number, frame in enumerate(np.linspace(0, clip.n_frames - 1, 4).astype(int)):
        axes = figure.add_subplot(1, 4, number + 1, projection="3d")
        model = clip.object.model
        moment = clip.object.points_in_world(model.vertices_m, model.part)[frame]
        mesh(axes, moment, model.faces, GREY)
        for side in SIDES:
            if clip.hands[side].valid[frame]:
                mesh(axes, hand_vertices(side, clip.hands[side], frame), HANDS[side].faces, COLOURS[side])
        centre = clip.object.translation_m.mean(axis=0)
        frame_of(axes, centre, 0.24)
        triad(axes, centre - np.array((0.2, 0.2, 0.2)), 0.08)
        axes.set_title(f"frame {frame}, {frame / 30:.2f} s", fontsize=9, y=-0.02)


def draw_conventions(figure: Figure, data: Path) -> None:
    """Plot the meaning of zero angles, translation and up axis in each source, on the same right hand."""
    model = HANDS["right"]
    wrist = model.wrist_offset_m(np.zeros((1, 10)))[0]
    for number, name in enumerate(built_in_names()):
        adapter, facts = get_adapter(name), dataset_facts(name)
        convention, frame = adapter.hand_convention, adapter.frame
        axes = figure.add_subplot(2, 4, number + 1, projection="3d")
        pose = model.mean_pose if convention.fingers == "mean-relative" else np.zeros(45)
        vertices = posed(pose)
        mesh(axes, vertices, model.faces, SAND, 0.9)
        origin = wrist if convention.translation == "wrist" else np.zeros(3)
        axes.computed_zorder = False
        axes.scatter(*origin, color=RED, s=34, depthshade=False, zorder=5)
        axes.plot(*np.stack([origin, wrist]).T, color=RED, linewidth=2, zorder=4)
        frame_of(axes, np.array((0.0, 0.0, 0.0)), 0.14, (14, -82))
        up = None if frame.up_axis is None else "xyz".index(frame.up_axis[-1])
        triad(axes, np.array((-0.1, 0.0, -0.13)), 0.05, up=up)
        reference = "the wrist" if convention.translation == "wrist" else "the wrist minus J0"
        lines = [
            f"translation: {reference}",
            f"zero angles: {'the mean pose' if convention.fingers == 'mean-relative' else 'a flat hand'}",
            f"shape: {convention.shape}",
            f"up: {frame.up_axis or frame.gravity}",
            f"{facts.source_fps:g} per second" if facts else "",
        ]
        axes.set_title(facts.title if facts else name, fontsize=11, fontweight="bold")
        axes.text2D(0.5, -0.02, "\n".join(lines), transform=axes.transAxes, ha="center", va="top", fontsize=8)


def posed(pose: np.ndarray) -> np.ndarray:
    """(778, 3) vertices of the right hand at its model's origin with absolute finger angles (45,)."""
    model, zero = HANDS["right"], np.zeros((1, 3))
    wrist = model.wrist_offset_m(np.zeros((1, 10)))
    track = HandTrack(wrist, zero, np.asarray(pose)[None], betas=np.zeros((1, 10)), valid=np.ones(1, bool))
    return hand_vertices("right", track, 0)


def draw_contact(figure: Figure, data: Path) -> None:
    """Plot the contact map of a clip and BimArt's distances in one frame, on the same 1,024 points."""
    annotated = load_annotated(data / "grab", HANDS)
    clip, sampled = annotated.clip(CLIP), annotated.points(annotated.object_key(CLIP))
    frame, side, points = clip.n_frames // 2, annotated.hand_type(CLIP), sampled.points_m
    side = "right" if side == "both" else side
    surface = measure_hand(clip, side, HANDS, sampled)
    touched = annotated.touched_frames(CLIP, side)
    maps = {
        "touched within 2 cm of a joint": (touched / clip.n_frames, TOUCH, "fraction of the frames"),
        f"metres to the {side} hand, frame {frame}": (surface.map_m[frame], "RdYlBu", "m"),
    }
    for number, (title, (values, colours, unit)) in enumerate(maps.items()):
        axes = figure.add_subplot(1, 2, number + 1, projection="3d")
        scatter = axes.scatter(*points.T, c=values, cmap=colours, s=9, depthshade=False)
        frame_of(axes, points.mean(axis=0), np.ptp(points, axis=0).max() * 0.5)
        axes.set_title(title, fontsize=10)
        figure.colorbar(scatter, ax=axes, shrink=0.6, label=unit)


def draw_hand_type(figure: Figure, data: Path) -> None:
    """Plot the distance of each hand to the object in each frame, which decides the hand type."""
    annotated = load_annotated(data / "grab", HANDS)
    evidence = annotated.hand_evidence(CLIP)
    axes: Axes = figure.add_subplot()
    for side in SIDES:
        axes.plot(evidence.distance_m[side] * 100, color=COLOURS[side], linewidth=2, label=f"{side} hand")
    axes.axhline(evidence.threshold_m * 100, color="#555555", linestyle="--", linewidth=1, label="threshold, 2 cm")
    axes.set_xlabel("frame, 30 per second")
    axes.set_ylabel("nearest joint to the object, cm")
    axes.set_yscale("log")
    axes.set_title(f"{CLIP}: hand type {annotated.hand_type(CLIP)}", loc="left", fontsize=10)
    axes.legend(frameon=False)


def draw_text_features(figure: Figure, data: Path) -> None:
    """Plot the cosine similarity of text features: the sentences of five clips."""
    annotated = load_annotated(data / "grab", HANDS)
    prompts: dict[tuple, str] = {}
    for clip_id in annotated.ids("test"):
        sentences = annotated.sentences(clip_id)
        prompts.setdefault(tuple(sentences), clip_id)
    chosen = list(prompts.values())[:5]
    features = np.concatenate([annotated.text_embedding(clip_id) for clip_id in chosen]).astype(np.float64)
    features /= np.linalg.norm(features, axis=1, keepdims=True)
    axes: Axes = figure.add_subplot()
    image = axes.imshow(features @ features.T, cmap="YlOrBr", vmin=0, vmax=1)
    axes.set_yticks(range(len(features)), [s for clip_id in chosen for s in annotated.sentences(clip_id)], fontsize=7)
    axes.set_xticks([])
    forms = len(FORMS)
    for edge in range(forms, len(features), forms):
        axes.axhline(edge - 0.5, color="white", linewidth=1.5)
        axes.axvline(edge - 0.5, color="white", linewidth=1.5)
    figure.colorbar(image, ax=axes, shrink=0.7, label="cosine of their features")


def draw_quality(figure: Figure, data: Path) -> None:
    """Plot all quality measures of all clips, as fractions of the limit above which they are reported."""
    axes: Axes = figure.add_subplot()
    folders = {name: data / name / "quality" for name in ("h2o", "grab", "arctic")}
    limits = json.loads((folders["h2o"] / "info.json").read_text())["thresholds"]["limits"]
    clips = {name: pd.read_parquet(folder / "clips.parquet") for name, folder in folders.items()}
    names = [name for name in reversed(limits) if name in clips["h2o"]]
    for offset, (dataset, colour) in zip((0.22, 0, -0.22), zip(clips, (BLUE, SAND, GREEN), strict=True), strict=True):
        for y, name in enumerate(names):
            fractions = clips[dataset][name].dropna().abs() / limits[name]["warn"]
            axes.plot(fractions, np.full(len(fractions), y + offset), "o", color=colour, alpha=0.5, markersize=4)
        axes.plot([], [], "o", color=colour, label=dataset_title(dataset))
    axes.axvline(1, color=RED, linewidth=1.5, label="reported above")
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.set_xlim(-0.03, 1.15)
    axes.set_xlabel("measure, as a fraction of its limit `warn`")
    axes.legend(frameon=False, fontsize=8, loc="center", bbox_to_anchor=(0.78, 0.22))


def draw_splits(figure: Figure, data: Path) -> None:
    """Plot clips by subject and object, coloured by subset, for two named splits of one corpus."""
    annotated = load_annotated(data / "grab", HANDS)
    clips = pd.read_parquet(data / "grab/splits/splits.parquet").merge(annotated.store.sequences.reset_index(drop=True))
    clips["subject"] = clips["subject"].astype(str)
    subjects = sorted(set(clips["subject"]), key=lambda name: (len(name), name))
    objects = sorted(set(clips["object"]))
    for number, name in enumerate(("text2hoi", "unseen-object")):
        axes: Axes = figure.add_subplot(1, 2, number + 1)
        for _, clip in clips.iterrows():
            colour = SUBSET_COLOURS.get(str(clip[name]), SUBSET_COLOURS["excluded"])
            axes.scatter(objects.index(clip["object"]), subjects.index(clip["subject"]), marker="s", s=70, color=colour)
        axes.set_xticks(range(len(objects)), objects, rotation=90, fontsize=7)
        axes.set_yticks(range(len(subjects)), subjects, fontsize=8)
        axes.set_title(name, loc="left", fontsize=10)
    legend = [Patch(color=colour, label=subset) for subset, colour in SUBSET_COLOURS.items()]
    figure.legend(handles=legend, ncol=4, loc="outside upper right", frameon=False, fontsize=8)


def draw_lineage(figure: Figure, data: Path) -> None:
    """Plot the DVC stages of one dataset and family, each below its inputs."""
    graph = {name: stage for name, stage in written_graph(data.parents[1]).items() if _is_plotted(name)}
    producers = {out: name for name, stage in graph.items() for out in stage.outs}
    parents = {name: {producers[path] for path in stage.data if path in producers} for name, stage in graph.items()}
    depth: dict[str, int] = {}
    while len(depth) < len(parents):
        ready = [name for name in parents if name not in depth and parents[name] <= depth.keys()]
        depth |= {name: 1 + max((depth[parent] for parent in parents[name]), default=-1) for name in ready}
    levels = [[name for name in depth if depth[name] == level] for level in range(max(depth.values()) + 1)]
    positions = {
        name: ((index + 0.5) / len(level), -number)
        for number, level in enumerate(levels)
        for index, name in enumerate(level)
    }
    axes: Axes = figure.add_subplot()
    arrow = {"arrowstyle": "-|>", "color": "#9aa0a6", "shrinkA": 11, "shrinkB": 11}
    for name, above in parents.items():
        for parent in above:
            axes.annotate("", positions[name], positions[parent], arrowprops=arrow)
    box = {"boxstyle": "round,pad=0.4", "facecolor": "#eef3f8", "edgecolor": BLUE}
    for name, position in positions.items():
        axes.text(*position, _label(name), ha="center", va="center", fontsize=9, bbox=box)
    axes.set_ylim(-len(levels) + 0.5, 0.5)
    axes.set_xlim(0, 1)
    axes.set_axis_off()


def _is_plotted(name: str) -> bool:
    stage, _, rest = name.rpartition(":")[2].partition("@")
    if (
        stage in ("code", "controls", "evaluator", "report")
        or not rest.startswith("embedded-grab")
        or "manipnet" in name
    ):
        return False
    return not stage.startswith(("sample", "evaluate")) or rest == "embedded-grab-text2hoi"


def _label(name: str) -> str:
    stage, _, rest = name.rpartition(":")[2].partition("@")
    network = rest.removeprefix("embedded-grab").removeprefix("-").removeprefix("text2hoi")
    return f"{stage.replace('-', ' ')} {network}".strip()


DRAWINGS: dict[str, tuple[Callable[[Figure, Path], None], tuple[float, float]]] = {
    "clip": (draw_clip, (12, 3.2)),
    "conventions": (draw_conventions, (12, 8.5)),
    "contact": (draw_contact, (10, 4.2)),
    "hand-type": (draw_hand_type, (8, 3.2)),
    "words": (draw_text_features, (9, 5)),
    "quality": (draw_quality, (9, 4.6)),
    "splits": (draw_splits, (11, 4.4)),
    "lineage": (draw_lineage, (9, 6)),
}


FLAT = ("hand-type", "words", "quality", "splits", "lineage")  # the others are 3D plots


def main(project: Path, names: list[str]) -> None:
    """Write all plots, or the named ones, to docs/images."""
    for name, (draw, inches) in DRAWINGS.items():
        if not names or name in names:
            figure = Figure(figsize=inches, layout="constrained" if name in FLAT else None)
            draw(figure, project / "data/embedded")
            figure.savefig(IMAGES / f"{name}.png", dpi=90, bbox_inches="tight", metadata={"Software": None})
            print(IMAGES / f"{name}.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
