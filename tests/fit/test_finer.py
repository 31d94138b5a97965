"""Which Gaussians may be split: not inside metal, and not those that are as small as they may be."""

import math

import numpy as np
import torch
from small_clouds import blocks, scene_of

from tomo_polysplat.fit.finer import may_be_finer


def test_metal_is_split_at_its_edge_alone_and_soft_matter_everywhere():
    gaussians, box = blocks([1.0, 10.0, 40.0], size=7)
    may = may_be_finer(gaussians, scene_of(box), -9.0).reshape(3, 7, 7, 7).numpy()
    assert may[0].all()
    # The blocks fill the volume across, beyond which they go on; they end along z alone.
    for block in may[1:]:
        assert block[:, :, [0, -1]].all() and not block[:, :, 1:-1].any()


def test_metal_of_one_slice_has_no_edge_above_and_below():
    gaussians, box = blocks([1.0, 10.0], size=7)
    # A slice through the middle of a block that is wider than the volume.
    layer = box.part((14 + 3, 0, 0), (1, 7, 7))
    assert not may_be_finer(gaussians, scene_of(layer), -9.0)[343:].any()


def test_a_sheet_of_metal_one_voxel_thin_has_edges_only():
    gaussians, box = blocks([1.0, 10.0], size=7)
    sheet = gaussians.select(torch.from_numpy(np.flatnonzero(gaussians.position[:, 0].numpy() == 3)))
    assert may_be_finer(sheet, scene_of(box), -9.0).all()


def test_halves_are_never_smaller_than_the_smallest():
    gaussians, box = blocks([1.0], size=3)
    gaussians.log_scale[:, 0] = torch.linspace(math.log(0.6), math.log(1.2), 27)
    may = may_be_finer(gaussians, scene_of(box), math.log(0.7))
    assert torch.equal(may, 0.7 * gaussians.log_scale.exp().amax(dim=1) >= 0.7)
