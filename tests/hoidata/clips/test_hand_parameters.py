"""The engine of hand parameters: every convention against a plain formula, and there and back."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.clips.hand_parameters import (
    FrameChange,
    HandConvention,
    SourceHand,
    absolute_fingers,
    hands_for,
    to_track,
    with_corrected_left,
)
from hoidata.errors import BadInput
from hoidata.hands import HandPair, load_embedded_hands, load_mano_hands
from tests.builders.formulas import joints_as_stored
from tests.builders.mano import write_mano_pickle

N_FRAMES = 7
PLAIN = HandConvention("transl", "absolute", "betas per sequence", "as released")


@pytest.fixture(scope="module")
def model():
    return load_embedded_hands().left


@pytest.fixture(scope="module")
def released(tmp_path_factory) -> HandPair:
    """A pair whose left shape directions have the sign of the file as MANO released it."""
    folder = tmp_path_factory.mktemp("mano")
    hands = load_embedded_hands()
    wrong = hands.left.shape_directions.copy()
    wrong[:, 0] = hands.right.shape_directions[:, 0]
    write_mano_pickle(replace(hands.left, shape_directions=wrong), folder / "MANO_LEFT.pkl")
    write_mano_pickle(hands.right, folder / "MANO_RIGHT.pkl")
    return load_mano_hands(folder)


def wrist_of(model, betas, template_m=None) -> np.ndarray:
    """J0 of one frame: the wrist row of the regressor on the shaped rest mesh."""
    template = model.template_m if template_m is None else template_m
    return sum(model.joint_regressor[0, v] * (template[v] + model.shape_directions[v] @ betas) for v in range(778))


def source_hand(seed: int = 0, columns: int = 45, betas: str = "sequence", template_m=None) -> SourceHand:
    rng = np.random.default_rng(seed)
    rows = {"sequence": 1, "frame": N_FRAMES}[betas]
    return SourceHand(
        translation_m=rng.normal(size=(N_FRAMES, 3)),
        global_orient=rng.normal(size=(N_FRAMES, 3)),
        fingers=rng.normal(scale=0.6, size=(N_FRAMES, columns)),
        betas=rng.normal(size=(rows, 10)).astype(np.float32),
        template_m=template_m,
    )


def frame_change(rows: int, seed: int = 3) -> FrameChange:
    rotation = Rotation.random(rows, random_state=np.random.RandomState(seed)).as_matrix()
    return FrameChange(rotation, np.random.default_rng(seed).normal(size=(rows, 3)))


def personal_mesh(model) -> np.ndarray:
    """Float32 as tracks keep it; larger than the model's and elsewhere, so that its wrist lies elsewhere."""
    return (model.template_m * 1.1 + (0.01, -0.02, 0.005)).astype(np.float32)


class TestTranslation:
    @pytest.mark.parametrize("betas", ["sequence", "frame"])
    def test_transl_puts_the_wrist_at_the_shaped_rest_wrist_plus_t(self, model, betas):
        source = source_hand(betas=betas)
        track = to_track(source, PLAIN, model)
        for frame in range(N_FRAMES):
            frame_betas = source.betas[0 if betas == "sequence" else frame]
            expected = wrist_of(model, frame_betas) + source.translation_m[frame]
            np.testing.assert_allclose(track.wrist_m[frame], expected, atol=1e-6)
            assert np.linalg.norm(expected - source.translation_m[frame]) > 0.05

    def test_wrist_puts_it_exactly_at_t(self, model):
        source = source_hand()
        track = to_track(source, replace(PLAIN, translation="wrist"), model)
        np.testing.assert_array_equal(track.wrist_m, source.translation_m.astype(np.float32))

    def test_a_personal_mesh_has_its_own_rest_wrist(self, model):
        mesh = personal_mesh(model)
        source = replace(source_hand(template_m=mesh), betas=np.zeros((1, 10)))
        track = to_track(source, replace(PLAIN, shape="personal mesh"), model)
        offset = wrist_of(model, np.zeros(10), mesh.astype(np.float64))
        np.testing.assert_allclose(track.wrist_m, source.translation_m + offset, atol=1e-6)
        assert np.linalg.norm(offset - wrist_of(model, np.zeros(10))) > 0.01
        np.testing.assert_array_equal(track.template_m, mesh)

    def test_betas_that_never_change_become_one_row_and_others_stay(self, model):
        source = source_hand(betas="frame")
        assert to_track(source, PLAIN, model).betas.shape == (N_FRAMES, 10)
        same = replace(source, betas=np.tile(source.betas[:1], (N_FRAMES, 1)))
        assert to_track(same, PLAIN, model).betas.shape == (1, 10)


class TestFingers:
    def test_absolute_angles_stay_and_relative_ones_gain_the_mean(self, model):
        source = source_hand()
        absolute = to_track(source, PLAIN, model).hand_pose
        relative = to_track(source, replace(PLAIN, fingers="mean-relative"), model).hand_pose
        np.testing.assert_allclose(absolute, source.fingers, atol=1e-6)
        np.testing.assert_allclose(relative, source.fingers + model.mean_pose, atol=1e-6)
        assert np.abs(model.mean_pose).max() > 0.1

    @pytest.mark.parametrize("components", [1, 2, 6, 15, 24, 44, 45])
    @pytest.mark.parametrize("kind", ["absolute", "mean-relative"])
    def test_components_of_any_number_are_weights_of_the_first_ones(self, model, components, kind):
        source = source_hand(columns=components)
        track = to_track(source, replace(PLAIN, fingers=kind, components=components), model)
        expected = np.zeros((N_FRAMES, 45))
        for number in range(components):
            expected += source.fingers[:, number, None] * model.components[number]
        expected += model.mean_pose if kind == "mean-relative" else 0
        np.testing.assert_allclose(track.hand_pose, expected, atol=1e-6)

    @pytest.mark.parametrize("fingers", ["absolute", "mean-relative"])
    def test_angles_beyond_pi_are_the_same_rotations_stored_as_at_most_pi(self, model, fingers):
        """The mean pose is added to the axis-angles of the source, not to canonical ones."""
        source = source_hand()
        source.fingers[:, 21:24] = (0.0, 0.0, 6.6)
        source.global_orient[:] = (0.0, 5.0, 0.0)
        track = to_track(source, replace(PLAIN, fingers=fingers), model)
        np.testing.assert_allclose(track.global_orient, np.tile((0, 5.0 - 2 * np.pi, 0), (N_FRAMES, 1)), atol=1e-6)
        meant = source.fingers + (model.mean_pose if fingers == "mean-relative" else 0)
        stored, meant = (array.astype(np.float64).reshape(-1, 15, 3) for array in (track.hand_pose, meant))
        assert np.linalg.norm(meant, axis=2).max() > 6
        assert np.linalg.norm(stored, axis=2).max() <= np.pi + 1e-6
        apart = Rotation.from_rotvec(stored.reshape(-1, 3)) * Rotation.from_rotvec(meant.reshape(-1, 3)).inv()
        assert apart.magnitude().max() < 1e-6
        others = np.arange(15) != 7
        np.testing.assert_allclose(stored[:, others], meant[:, others], atol=1e-6)

    @pytest.mark.parametrize(("components", "columns"), [(0, 44), (24, 45), (45, 24), (6, 1)])
    def test_another_number_of_columns_is_refused(self, model, components, columns):
        with pytest.raises(BadInput) as caught:
            absolute_fingers(np.zeros((2, columns)), replace(PLAIN, components=components), model)
        assert f"{components or 45} columns" in caught.value.expected

    @pytest.mark.parametrize("components", [-1, 46])
    def test_a_convention_cannot_have_another_number_of_components(self, components):
        with pytest.raises(BadInput) as caught:
            replace(PLAIN, components=components)
        assert "0 (axis-angles) to 45" in caught.value.expected


class TestFrame:
    @pytest.mark.parametrize("rows", [1, N_FRAMES])
    def test_every_joint_moves_with_the_frame(self, model, rows):
        source, change = source_hand(betas="frame"), frame_change(rows)
        before, after = to_track(source, PLAIN, model), to_track(source, PLAIN, model, change)
        for frame in range(N_FRAMES):
            beta_index = 0 if rows == 1 else frame
            rotation, shift = change.rotation[beta_index], change.translation_m[beta_index]
            expected = joints_as_stored(before, model, frame) @ rotation.T + shift
            np.testing.assert_allclose(joints_as_stored(after, model, frame), expected, atol=3e-6)
        np.testing.assert_array_equal(before.hand_pose, after.hand_pose)

    def test_a_turn_without_a_shift_leaves_the_origin(self):
        change = FrameChange(frame_change(1).rotation)
        np.testing.assert_array_equal(change.points(np.zeros((2, 3))), np.zeros((2, 3)))


class TestValidFrames:
    @pytest.mark.parametrize("garbage", [np.nan, np.inf, 1e30, -7.0])
    @pytest.mark.parametrize("betas", ["sequence", "frame"])
    def test_nothing_in_a_frame_that_does_not_count_can_matter(self, model, garbage, betas):
        valid = np.array([True, False, True, True, False, True, False])
        source = source_hand(betas=betas)
        spoilt = {
            name: np.where(valid[:, None], getattr(source, name), garbage)
            for name in ("translation_m", "global_orient", "fingers", *(["betas"] if betas == "frame" else []))
        }
        clean = to_track(replace(source, valid=valid), PLAIN, model, frame_change(1))
        track = to_track(replace(source, valid=valid, **spoilt), PLAIN, model, frame_change(1))
        for name in ("wrist_m", "global_orient", "hand_pose", "betas", "valid"):
            np.testing.assert_array_equal(getattr(track, name), getattr(clean, name))
            assert np.isfinite(getattr(track, name)).all()
        assert not track.wrist_m[~valid].any()
        assert not track.hand_pose[~valid].any()
        assert track.valid.tolist() == valid.tolist()

    def test_betas_that_differ_only_where_they_do_not_count_become_one_row(self, model):
        source = source_hand(betas="frame")
        betas = np.tile(source.betas[2], (N_FRAMES, 1))
        betas[:2] = 9.0
        valid = np.arange(N_FRAMES) >= 2
        track = to_track(replace(source, betas=betas, valid=valid), PLAIN, model)
        np.testing.assert_array_equal(track.betas, source.betas[2:3])

    def test_a_hand_that_is_never_there_has_zeros(self, model):
        source = replace(source_hand(betas="frame"), valid=np.zeros(N_FRAMES, bool))
        track = to_track(source, PLAIN, model)
        assert not track.valid.any()
        assert track.betas.shape == (1, 10)
        assert not any(array.any() for array in (track.wrist_m, track.global_orient, track.hand_pose, track.betas))


class TestLeftShape:
    """In the released MANO_LEFT the shape directions of x have the right hand's sign, although the mesh is mirrored."""

    def test_the_correction_turns_the_sign_of_x_on_the_left_hand_only(self, released):
        mended = with_corrected_left(released)
        np.testing.assert_array_equal(mended.left.shape_directions[:, 0], -released.left.shape_directions[:, 0])
        np.testing.assert_array_equal(mended.left.shape_directions[:, 1:], released.left.shape_directions[:, 1:])
        assert mended.right is released.right
        assert mended.digest != released.digest

    def test_it_is_made_once_and_never_on_a_file_that_was_mended(self, released):
        mended = with_corrected_left(released)
        assert with_corrected_left(mended) is mended
        embedded = load_embedded_hands()
        assert with_corrected_left(embedded) is embedded

    @pytest.mark.parametrize(("flag", "is_mended"), [("as released", False), ("corrected", True), ("unused", False)])
    def test_the_convention_says_whether_and_its_record_keeps_it(self, released, flag, is_mended):
        convention = replace(PLAIN, left_shape=flag)
        hands = hands_for(convention, released)
        assert (hands.left is not released.left) == is_mended
        assert convention.as_json()["left_shape"] == flag
