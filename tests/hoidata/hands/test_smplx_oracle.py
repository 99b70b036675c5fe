"""The hand layer against smplx, the reference implementation of MANO, on the same MANO-format file."""

import contextlib
import io

import numpy as np
import pytest
import smplx
import torch

from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import TIP_VERTICES, HandKinematics, load_embedded_hands, load_mano_hands
from tests.builders.mano import write_mano_pickle

BATCH = 32


@pytest.fixture(scope="module")
def mano_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mano")
    pair = load_embedded_hands()
    write_mano_pickle(pair.left, folder / "MANO_LEFT.pkl")
    write_mano_pickle(pair.right, folder / "MANO_RIGHT.pkl")
    return folder


def oracle(folder, side, flat, dtype, inputs, **options):
    # smplx prints its 10 shape coefficients at each construction.
    with contextlib.redirect_stdout(io.StringIO()) as output:
        options |= {"use_pca": False, "flat_hand_mean": flat, "batch_size": BATCH, "dtype": dtype}
        layer = smplx.MANO(str(folder), is_rhand=side == "right", **options)
    assert "10 shape coefficients" in output.getvalue()
    out = layer(**inputs)
    return out.vertices.detach(), out.joints.detach()


def random_inputs(dtype):
    generator = torch.Generator().manual_seed(3)
    deviations = {"betas": (10, 1.0), "hand_pose": (45, 0.5), "global_orient": (3, 1.5), "transl": (3, 0.5)}
    return {
        name: (torch.randn(BATCH, size, generator=generator, dtype=torch.float64) * deviation).to(dtype)
        for name, (size, deviation) in deviations.items()
    }


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("flat", [True, False])
@pytest.mark.parametrize(("dtype", "tolerance_m"), [(torch.float32, 1e-6), (torch.float64, 1e-7)])
def test_layer_equals_smplx(mano_folder, side, flat, dtype, tolerance_m):
    model = load_mano_hands(mano_folder)[side]
    inputs = random_inputs(dtype)
    expected_vertices, expected_joints = oracle(mano_folder, side, flat, dtype, inputs)

    mean = 0.0 if flat else torch.as_tensor(model.mean_pose, dtype=dtype)
    pose = torch.cat((inputs["global_orient"], inputs["hand_pose"] + mean), 1)
    rotmats = rotvec_to_rotmat(pose.reshape(BATCH, 16, 3))
    wrist_m = inputs["transl"] + torch.as_tensor(model.wrist_offset_m(inputs["betas"].numpy()), dtype=dtype)
    vertices, joints = HandKinematics(model, dtype)(wrist_m, rotmats, inputs["betas"])

    error_m = max((vertices - expected_vertices).abs().max(), (joints[:, :16] - expected_joints).abs().max())
    assert error_m < tolerance_m
    assert (joints[:, 16:] - expected_vertices[:, list(TIP_VERTICES)]).abs().max() < tolerance_m
    assert not flat or np.abs(model.mean_pose).max() > 0.1  # otherwise the mean-pose case tests nothing


def test_layer_equals_smplx_on_a_personal_template(mano_folder):
    model = load_mano_hands(mano_folder).right
    personal = model.template_m * 1.07 + np.array([0.004, -0.01, 0.02])
    inputs = random_inputs(torch.float64) | {"betas": torch.zeros(BATCH, 10, dtype=torch.float64)}
    expected, _ = oracle(mano_folder, "right", True, torch.float64, inputs, v_template=torch.as_tensor(personal))
    pose = torch.cat((inputs["global_orient"], inputs["hand_pose"]), 1)
    wrist_m = inputs["transl"] + torch.as_tensor(model.wrist_offset_m(np.zeros((1, 10)), personal))
    vertices, _ = HandKinematics(model, torch.float64)(
        wrist_m, rotvec_to_rotmat(pose.reshape(BATCH, 16, 3)), inputs["betas"], torch.as_tensor(personal)
    )
    assert (vertices - expected).abs().max() < 1e-7
