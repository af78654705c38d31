from pathlib import Path

import numpy as np
import pytest
import torch
from pydrake.math import RigidTransform, RollPitchYaw
from torchvision.models import mobilenet_v2

from splatpilot.systems.policies import student
from splatpilot.systems.policies.base import Observation
from splatpilot.systems.vehicle.state import QuadrotorState
from splatpilot.training.policies.networks import IN_DATA, StudentModule, imagenet_weights
from splatpilot.training.policies.student_data import encode_images


def disturbed(module: StudentModule) -> StudentModule:
    """With biases that are not zero, so that none may be forgotten."""
    with torch.no_grad():
        for name, values in module.named_parameters():
            if name.endswith("bias"):
                values.normal_(0.0, 0.1)
    return module


@pytest.mark.parametrize("observation", ["rgb", "depth"])
@pytest.mark.parametrize("size", [(64, 48), (80, 70)])
@pytest.mark.parametrize("p_WG", [[4.0, 2.0, 1.5], [1.0, -2.0, 0.5], [0.0, 0.0, 0.0]])
def test_flight_computes_what_training_computes(observation, size, p_WG):
    torch.manual_seed(0)
    spec = student.StudentSpec(observation, *size, head_features=20, nominal_speed=2.6)
    module = disturbed(StudentModule(spec))
    weights = {name: w.numpy() for name, w in module.state_dict().items()}
    assert {name: w.shape for name, w in weights.items()} == spec.weight_shapes()
    rng = np.random.default_rng(0)
    color = rng.integers(0, 256, (size[1], size[0], 3)).astype(np.uint8)
    depth = rng.uniform(0.2, 25.0, (size[1], size[0])).astype(np.float16).astype(np.float32)
    depth[0, 0], depth[1, 1] = 0.0, np.inf
    rotation, p_WB, v_WB = RollPitchYaw(0.3, -0.2, 2.0), rng.normal(size=3), rng.normal(size=3)
    X_WB, p_WG = RigidTransform(rotation, p_WB), np.array(p_WG)
    R_WB = X_WB.rotation().matrix()
    labels = (R_WB, R_WB.T @ v_WB, R_WB.T @ (p_WG - p_WB))
    state = student.encode_state(*(torch.tensor(x).float()[None] for x in labels), spec.reach)

    image = color if observation == "rgb" else depth
    with torch.no_grad():
        expected = module(encode_images(image[None]), state)
    still = QuadrotorState(p_WB, v_WB, rotation.ToQuaternion().wxyz(), np.zeros(3))
    seen = Observation(0.5, X_WB, still, p_WG, image)
    found = student.plan(student.StudentNetwork(spec, weights), seen)
    np.testing.assert_allclose(found.waypoints_B, expected[0][0], atol=1e-4)
    np.testing.assert_allclose(found.costs, expected[1][0], atol=1e-4)
    assert np.ptp(found.costs) > 1e-3 and found.plan_time == 0.5


def test_images_of_another_size_are_refused():
    spec = student.StudentSpec("depth", 64, 48)
    weights = {name: np.zeros(shape, np.float32) for name, shape in spec.weight_shapes().items()}
    message = r"must be \(3, 48, 64\), got \(3, 48, 65\); give it a camera of 64x48"
    with pytest.raises(ValueError, match=message):
        student.StudentNetwork(spec, weights)(np.zeros((3, 48, 65), np.float32), np.zeros(6))


def test_untrained_encoder_keeps_the_variance_of_images():
    torch.manual_seed(0)
    module = StudentModule(student.StudentSpec("rgb", 96, 64))
    with torch.no_grad():
        features = module.features(torch.rand(4, 3, 64, 96) * 2.0 - 1.0)
    assert 0.05 < features.std().item() < 2.0
    assert (features[0] - features[1]).abs().mean() > 0.01


def test_frozen_modules_and_modules_in_parts():
    module = StudentModule(student.StudentSpec("depth", 64, 48))
    module.image_modules(14).requires_grad_(False)
    image, state = torch.randn(2, 3, 48, 64), torch.randn(2, student.STATE_SIZE)
    whole = module(image, state)
    for first in 0, 14, 19, 20:
        parts = module(module.encode_image(image, 0, first), state, first)
        assert torch.equal(whole[0], parts[0]) and torch.equal(whole[1], parts[1])
    (whole[0].square().sum() + whole[1].sum()).backward()
    frozen = [p.grad is None for p in module.features[:14].parameters()]
    assert all(frozen) and all(p.grad is not None for p in module.features[14:].parameters())


@pytest.fixture
def encoder_file(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("SPLATPILOT_DATA", str(tmp_path))
    (tmp_path / IN_DATA).parent.mkdir()
    return tmp_path / IN_DATA


def test_batch_norms_and_scaling_are_folded(encoder_file):
    torch.manual_seed(0)
    theirs = mobilenet_v2()
    with torch.no_grad():
        for module in theirs.modules():
            if isinstance(module, torch.nn.BatchNorm2d):
                for name, values in module.state_dict().items():
                    if name in ("weight", "running_var"):
                        values.uniform_(0.5, 1.5)
                    elif name != "num_batches_tracked":
                        values.normal_(0.0, 0.1)
    torch.save(theirs.state_dict(), encoder_file)
    weights = imagenet_weights()
    image = torch.rand(1, 3, 64, 96)
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    scaled = (image - mean[:, None, None]) / std[:, None, None]
    with torch.no_grad():
        first = theirs.eval().features[0](scaled)
        rest = theirs.features[1:](first)
    module = StudentModule(student.StudentSpec(way_version=2))
    module.load_state_dict(weights, strict=False)
    with torch.no_grad():
        ours = module.features[0](2.0 * image - 1.0)
        torch.testing.assert_close(ours[..., 1:, 1:], first[..., 1:, 1:], atol=1e-5, rtol=0)
        torch.testing.assert_close(module.features[1:](first), rest, atol=1e-4, rtol=1e-3)


def test_folded_weights_keep_their_scaling(encoder_file):
    theirs = mobilenet_v2()
    torch.save(theirs.state_dict(), encoder_file)
    weights = imagenet_weights()
    assert weights.keys() == student.mobilenet_shapes().keys()
    first = theirs.state_dict()["features.0.0.weight"]
    torch.testing.assert_close(weights["features.0.0.weight"], first, atol=1e-5, rtol=1e-4)


def test_other_files_are_refused(encoder_file, tmp_path, monkeypatch):
    torch.save({"layer.weight": torch.zeros(3)}, encoder_file)
    with pytest.raises(ValueError, match=r"imagenet\.pt: must be a state dictionary"):
        imagenet_weights()
    encoder_file.unlink()
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"imagenet\.pt or .*7ebf99e0\.pth; download"):
        imagenet_weights()
    (tmp_path / "checkpoints").mkdir()
    torch.save(mobilenet_v2().state_dict(), tmp_path / "checkpoints/mobilenet_v2-7ebf99e0.pth")
    assert imagenet_weights().keys() == student.mobilenet_shapes().keys()
