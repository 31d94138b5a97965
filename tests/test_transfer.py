import numpy as np
import pytest
import torch

from tomo_polysplat.transfer import copied, to_device, to_host


def test_on_the_host_nothing_is_copied():
    array = np.arange(6.0).reshape(2, 3)
    tensor = to_device(array, torch.device("cpu"))
    assert tensor.data_ptr() == array.ctypes.data
    assert to_host(tensor).ctypes.data == array.ctypes.data


@pytest.mark.gpu
@pytest.mark.parametrize("shape", [(), (0, 5), (17, 3), (3, 61, 239, 257), (1 << 24,)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_what_goes_to_a_gpu_and_comes_back_is_the_same_to_the_bit(shape, dtype):
    array = np.asarray(np.random.default_rng(0).random(shape, dtype))
    there = to_device(array, torch.device("cuda"))
    assert there.is_cuda and tuple(there.shape) == shape
    # What is on the way while its source changes would come out wrong.
    back = to_host(there)
    there.zero_()
    assert back.dtype == dtype and np.array_equal(back, array)


@pytest.mark.gpu
def test_a_tensor_that_is_not_contiguous_comes_back_in_its_order():
    there = torch.rand((211, 307, 101), device="cuda").permute(2, 0, 1)
    assert np.array_equal(to_host(there), there.cpu().numpy())


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
@pytest.mark.parametrize("slices", [0, 3, 90])
def test_what_comes_back_can_be_written_where_it_belongs(device, slices):
    there = torch.rand((slices, 239, 257), device=device)
    whole = np.full((2, 100, 239, 257), np.nan, np.float32)
    to_host(there, whole[1, 5 : 5 + slices])
    assert np.array_equal(whole[1, 5 : 5 + slices], there.cpu().numpy())
    assert np.isfinite(whole).sum() == there.numel()


@pytest.mark.parametrize(
    "ends",
    [
        ("cpu", "cpu"),
        *(
            pytest.param(e, marks=pytest.mark.gpu)
            for e in (("cpu", "cuda"), ("cuda", "cpu"), ("cuda", "cuda"))
        ),
    ],
)
@pytest.mark.parametrize("pinned", [False, pytest.param(True, marks=pytest.mark.gpu)])
def test_a_copy_shares_no_memory(ends, pinned):
    source = torch.arange(1 << 23).reshape(-1, 4).to(ends[0])
    source = source.pin_memory() if pinned and not source.is_cuda else source
    copy = copied(source, torch.device(ends[1]))
    assert copy.device.type == ends[1] and torch.equal(copy.cpu(), source.cpu())
    source.zero_()
    assert int(copy.max()) == (1 << 23) - 1
