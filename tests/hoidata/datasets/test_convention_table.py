"""Every cell of the table of conventions has its test."""

import re
from pathlib import Path

import pytest

HERE = Path(__file__).parent
TABLE = HERE.parents[2] / "hoidata" / "adapters" / "CONVENTIONS.md"
DATASETS = ("h2o", "grab", "arctic", "manipnet", "taco")
# Convention -> dataset -> the test that fails when it is flipped.
TESTS = {
    "unit": {
        "h2o": "test_everything_is_in_metres",
        "grab": "test_meshes_and_places_are_metres",
        "arctic": "test_the_translation_is_in_millimetres",
        "manipnet": "test_a_unit_is_a_decimetre",
        "taco": "test_meshes_are_in_centimetres_and_motion_in_metres",
    },
    "handedness of the world": {
        "h2o": "test_the_object_goes_from_its_frame_through_the_camera_to_the_world",
        "grab": "test_the_world_is_not_seen_in_a_mirror",
        "arctic": "test_the_world_is_not_seen_in_a_mirror",
        "manipnet": "test_the_world_is_seen_in_a_mirror_with_normal_x",
        "taco": "test_the_world_is_not_seen_in_a_mirror",
    },
    "meshes": {
        "h2o": "test_the_object_goes_from_its_frame_through_the_camera_to_the_world",
        "grab": "test_objects_turn_about_the_origin_of_their_mesh_not_its_middle",
        "arctic": "test_the_mesh_is_in_millimetres",
        "manipnet": "test_meshes_are_right_handed_already",
        "taco": "test_meshes_are_in_centimetres_and_motion_in_metres",
    },
    "object rotation": {
        "h2o": "test_the_object_goes_from_its_frame_through_the_camera_to_the_world",
        "grab": "test_objects_are_turned_as_row_vectors",
        "arctic": "test_it_is_turned_as_column_vectors",
        "manipnet": "test_object_matrices_act_on_columns",
        "taco": "test_object_matrices_act_on_columns",
    },
    "hand translation": {
        "h2o": "test_the_translation_is_added_to_the_rest_wrist",
        "grab": "test_the_hand_turns_about_its_rest_wrist_and_is_moved_by_transl",
        "arctic": "test_the_hand_turns_about_its_shaped_rest_wrist_and_is_moved_by_trans",
        "manipnet": "test_the_thumbs_first_joint_is_its_second_one_in_the_file",
        "taco": "test_the_translation_is_the_wrist_and_not_added_to_the_rest_wrist",
    },
    "finger angles": {
        "h2o": "test_fingers_are_absolute_and_the_mean_pose_is_not_added",
        "grab": "test_fingers_are_absolute",
        "arctic": "test_fingers_are_relative_to_the_mean_pose",
        "manipnet": "test_angles_turn_about_y_then_x_then_z_of_the_turned_frame",
        "taco": "test_fingers_are_absolute",
    },
    "principal components": {
        "grab": "test_components_are_weights_of_the_models_first_rows_without_the_mean",
    },
    "angles beyond pi": {
        "arctic": "test_angles_beyond_pi_gain_the_mean_as_they_are",
    },
    "shape": {
        "h2o": "test_betas_are_read_in_every_frame",
        "grab": "test_the_rest_mesh_is_the_subjects_own_and_there_are_no_betas",
        "arctic": "test_one_row_of_betas_holds_for_the_whole_sequence",
        "taco": "test_each_side_has_its_own_shape",
    },
    "left shape directions": {
        "h2o": "test_left_betas_belong_to_the_shape_directions_as_released",
        "arctic": "test_left_betas_belong_to_the_shape_directions_as_mano_released_them",
        "taco": "test_left_shape_directions_stay_as_released",
    },
    "left and right": {
        "h2o": "test_the_left_block_comes_first",
        "grab": "test_each_hands_numbers_bend_a_hand_of_that_side",
        "arctic": "test_each_hands_numbers_bend_a_hand_of_that_side",
        "manipnet": "test_a_right_hand_is_fitted_to_the_right_hands_file",
        "taco": "test_each_hands_numbers_bend_a_hand_of_that_side",
    },
    "numbers per hand": {
        "h2o": "test_a_block_has_62_numbers_and_not_the_59_of_the_readme",
    },
    "joint order": {
        "h2o": "test_joint_files_list_the_thumb_first_and_ring_before_pinky",
        "manipnet": "test_the_ring_finger_comes_before_the_little_one_in_the_file_and_after_it_here",
    },
    "finger tips": {
        "manipnet": "test_tips_are_the_ends_of_the_capsules_not_the_end_sites",
    },
    "parts": {
        "arctic": "test_part_0_of_the_file_is_the_top_and_moves",
    },
    "hinge": {
        "arctic": "test_the_hinge_turns_about_minus_z",
    },
    "camera": {
        "h2o": "test_camera_files_are_camera_to_world_and_not_its_inverse",
        "arctic": "test_the_file_takes_the_world_to_the_camera_and_the_clip_the_camera_to_the_world",
    },
    "frames": {
        "h2o": "test_the_last_labelled_frame_belongs_to_the_clip",
        "grab": "test_every_fourth_frame_counts_from_the_first_of_the_file_and_both_ends_of_the_contact_stay",
        "arctic": "test_ranges_count_from_one_and_include_both_ends",
        "manipnet": "test_the_116_hz_file_is_read_by_its_own_clock",
        "taco": "test_frame_keys_are_sorted_as_numbers",
    },
    "validity": {
        "h2o": "test_a_hand_without_its_flag_is_not_valid_although_numbers_stand_there",
    },
    "labels": {
        "h2o": "test_label_seven_is_grab_chips_and_class_seven_is_chips",
    },
    "gravity": {
        "h2o": "test_gravity_is_where_the_objects_stand",
        "grab": "test_things_fall_along_minus_z",
        "arctic": "test_things_fall_along_minus_z",
        "manipnet": "test_things_fall_along_minus_y",
        "taco": "test_gravity_is_unknown_with_its_reason",
    },
}
OTHER_FILES = {"test_gravity_is_where_the_objects_stand": "test_gravity.py"}


def cells() -> dict[tuple[str, str], str]:
    """(convention, dataset) -> what the table says."""
    rows = [line.strip("| ").split(" | ") for line in TABLE.read_text().splitlines() if line.startswith("|")][2:]
    return {(row[0], name): text for row in rows for name, text in zip(DATASETS, row[1:], strict=True)}


def test_every_cell_that_says_something_has_a_test_and_no_other() -> None:
    stated = {place for place, text in cells().items() if text != "-"}
    assert stated == {(convention, name) for convention, tests in TESTS.items() for name in tests}
    assert len(stated) >= 60


@pytest.mark.parametrize(
    ("dataset", "test"), sorted({(name, test) for tests in TESTS.values() for name, test in tests.items()})
)
def test_the_test_of_a_cell_exists(dataset: str, test: str) -> None:
    source = (HERE / OTHER_FILES.get(test, f"test_conventions_{dataset}.py")).read_text()
    assert re.search(rf"def {test}\(", source)
