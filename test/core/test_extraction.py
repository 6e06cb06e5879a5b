"""Features of images: keypoints where things are, whatever the pyramid, and descriptors that COLMAP would have made."""

import image_world
import numpy as np
import pytest

from xalign_ros.core.descriptors import pair_distance
from xalign_ros.core.extraction import EXTRACTORS, sift
from xalign_ros.core.records import Norm

IMAGE = image_world.painted(np.random.default_rng(3), 501, 347, 900)


@pytest.mark.parametrize("name", EXTRACTORS)
def test_a_turned_image_has_turned_keypoints(name) -> None:
    """Half a turn about the image's centre. Where a level of the pyramid shifts its keypoints, none of them comes back."""
    extract = EXTRACTORS[name]
    uv, turned = extract(IMAGE).uv, extract(np.ascontiguousarray(IMAGE[::-1, ::-1])).uv
    back = np.array([IMAGE.shape[1] - 1, IMAGE.shape[0] - 1]) - turned
    gap = np.linalg.norm(uv[:, None] - back, axis=2).min(axis=1)
    assert len(uv) > 300
    assert np.mean(gap < 0.05) > 0.9


@pytest.mark.parametrize("name", EXTRACTORS)
def test_counts_kinds_and_an_image_with_nothing_on_it(name) -> None:
    extract = EXTRACTORS[name]
    full, few = extract(IMAGE), extract(IMAGE, 100)
    assert 50 <= len(few) <= 110 < len(full)  # OpenCV keeps keypoints that are equally strong
    assert (full.name, full.descriptors.dtype) == (name, np.uint8)
    colour = extract(np.repeat(IMAGE[:, :, None], 3, axis=2))
    np.testing.assert_array_equal(colour.uv, full.uv)
    empty = extract(np.full((80, 90), 128, np.uint8))
    assert empty.descriptors.shape == (0, full.descriptors.shape[1])


def test_sift_is_that_of_colmap() -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="COLMAP's own extractor is the peer")
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    keypoints, descriptors = pycolmap.FeatureExtractor.create(options).extract(pycolmap.Bitmap.from_array(IMAGE))
    uv, theirs = np.array([[k.x, k.y] for k in keypoints]), np.asarray(descriptors.data)
    ours = sift(IMAGE, 10_000)
    assert len(ours) == pytest.approx(len(uv), rel=0.2)
    i, j = np.nonzero(np.linalg.norm(ours.uv[:, None] - (uv - 0.5), axis=2) < 0.3)
    distance = pair_distance(ours.descriptors[i], theirs[j], Norm.L2_UINT8)
    best = np.full(len(ours), np.inf)
    np.minimum.at(best, i, distance)  # a place may have several orientations
    assert np.isfinite(best).mean() > 0.85
    assert np.median(best[np.isfinite(best)]) < 80  # of other keypoints: over 300
    assert np.abs(np.median((ours.uv[i] - (uv - 0.5)[j])[distance < 150], axis=0)).max() < 0.01
