"""Pickles that run code are refused before anything runs; those of body models become plain arrays."""

import os
import pickle
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse
import torch

from fitting.safe_pickle import load_arrays, load_model
from tests import flame_file

LOADERS = [load_arrays, load_model]


class Call:
    """Pickles as a call of any function."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def small() -> dict:
    return {
        "v_template": np.arange(12.0).reshape(4, 3),
        "J_regressor": scipy.sparse.csc_matrix(np.eye(2, 4)),
        "kintree_table": np.array([[4294967295, 0]], np.uint32),
        "bs_style": "lbs",
        "more": OrderedDict(count=np.float64(3.5), names=["a", "b"]),
    }


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4])
def test_body_model_in_every_protocol(tmp_path, protocol):
    path = flame_file.write(tmp_path / "model.pkl", small(), ("v_template",), protocol)
    loaded = load_model(path)
    np.testing.assert_array_equal(loaded["v_template"], small()["v_template"])
    np.testing.assert_array_equal(loaded["J_regressor"], np.eye(2, 4))
    assert loaded["kintree_table"].dtype == np.uint32 and loaded["bs_style"] == "lbs"
    assert loaded["more"] == {"count": 3.5, "names": ["a", "b"]}


def test_python_2_pickle(tmp_path):
    """As Python 2 wrote it: byte strings for text and for array data, modules under their old names."""
    path = tmp_path / "old.pkl"
    path.write_bytes(
        b"(dp0\nS'weights'\np1\ncnumpy.core.multiarray\n_reconstruct\np2\n(cnumpy\nndarray\np3\n(I0\ntp4\nS'b'\np5\ntp6\nRp7\n"
        b"(I1\n(I2\ntp8\ncnumpy\ndtype\np9\n(S'f8'\np10\nI0\nI1\ntp11\nRp12\n(I3\nS'<'\np13\nNNNI-1\nI-1\nI0\ntp14\nbI00\n"
        b"S'\\x00\\x00\\x00\\x00\\x00\\x00\\xf0?\\x00\\x00\\x00\\x00\\x00\\x00\\x00\\xc0'\np15\ntp16\nbsS'style'\np17\nS'lbs'\np18\ns."
    )
    loaded = load_model(path)
    np.testing.assert_array_equal(loaded["weights"], [1.0, -2.0])
    assert loaded["style"] == "lbs"


def test_slice_of_a_chumpy_array(tmp_path):
    path = tmp_path / "slice.pkl"
    with flame_file.chumpy_module() as make:
        whole, part = make(), make()
        whole.__dict__.update(x=np.arange(10.0))
        part.__dict__.update(a=whole, idxs=np.array([7, 1, 2, 8]), preferred_shape=(2, 2))
        path.write_bytes(pickle.dumps({"shapedirs": part}, protocol=2))
    np.testing.assert_array_equal(load_model(path)["shapedirs"], [[7, 1], [2, 8]])


@pytest.mark.parametrize("load", LOADERS)
@pytest.mark.parametrize(
    "make",
    [
        lambda mark: Call(os.system, f"touch {mark}"),
        lambda mark: Call(eval, f"open({str(mark)!r}, 'w')"),
        lambda mark: Call(exec, f"open({str(mark)!r}, 'w')"),
        lambda mark: Call(getattr, Path(mark), "touch"),
        lambda mark: Call(torch.load, str(mark)),
        lambda mark: Call(torch.storage._load_from_bytes, pickle.dumps(Call(os.system, f"touch {mark}"))),
        lambda mark: Call(np.load, str(mark)),
        lambda mark: torch.zeros(2),
        lambda mark: Call(scipy.sparse.load_npz, str(mark)),
    ],
    ids=["os.system", "eval", "exec", "getattr", "torch.load", "torch storage", "numpy.load", "tensor", "scipy"],
)
@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_nothing_is_executed(tmp_path, load, make, protocol):
    mark = tmp_path / "executed"
    path = tmp_path / "evil.pkl"
    path.write_bytes(pickle.dumps({"v_template": make(mark)}, protocol=protocol))
    with pytest.raises(ValueError, match=r"evil\.pkl: refused, .*which is not an array"):
        load(path)
    assert not mark.exists()


def test_the_test_would_notice(tmp_path):
    """The same pickle, loaded without care, does leave its mark."""
    mark = tmp_path / "executed"
    pickle.loads(pickle.dumps(Call(os.system, f"touch {mark}")))
    assert mark.exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([1, 2], "found a list at the top"),
        ({1: np.zeros(2)}, "found a key of type int"),
        ({"a": {1, 2}}, "set"),
        ({"a": np.array([{}, None], object)}, "object"),
        ({"a": Call(np.ndarray, (2,), "O")}, "found a ndarray at /a"),
    ],
    ids=["list", "key", "set", "objects", "typed objects"],
)
def test_what_is_no_model_is_named(tmp_path, content, message):
    path = tmp_path / "other.pkl"
    path.write_bytes(pickle.dumps(content, protocol=2))
    with pytest.raises(ValueError, match=message):
        load_model(path)


def test_sparse_matrix_with_indices_outside(tmp_path):
    """scipy's own code trusts the indices: one outside would write into foreign memory."""
    matrix = scipy.sparse.csc_matrix(np.eye(3))
    matrix.indices[1] = 4000
    path = tmp_path / "sparse.pkl"
    path.write_bytes(pickle.dumps({"J_regressor": matrix}))
    with pytest.raises(ValueError, match=r"sparse\.pkl: refused"):
        load_model(path)


def test_attributes_cannot_be_set_on_what_stays(tmp_path):
    """BUILD with a slot state sets attributes: what is handed out must refuse it or be made for this file alone."""
    for name in ("numpy dtype", "_codecs encode", "copy_reg _reconstructor"):
        module, attribute = name.split()
        body = f"c{module}\n{attribute}\n(N(dS'__doc__'\nS'changed'\nstb.".encode()
        path = tmp_path / "build.pkl"
        path.write_bytes(body)
        with pytest.raises(ValueError, match="refused"):
            load_model(path)


@pytest.mark.parametrize("load", LOADERS)
def test_damaged_file(tmp_path, load):
    path = tmp_path / "half.pkl"
    whole = pickle.dumps({"v_template": np.zeros((40, 3))})
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"half\.pkl: refused"):
        load(path)
