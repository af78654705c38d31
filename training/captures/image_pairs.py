"""Which photographs are compared: of many, those that are neighbours or look alike.

Alike is what local features say: their descriptors, each by its difference from the nearest of
`_WORDS` typical ones, are summed up to one vector an image (VLAD; Jegou et al. 2010), and vectors
are compared by the cosine between them.
"""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2, vq

if TYPE_CHECKING:
    import pycolmap

_WORDS = 32
_SAMPLE = 50_000
"""Descriptors that the typical ones are found from."""


def all_pairs(count: int) -> list[tuple[int, int]]:
    """Every two of `count` images, by number."""
    return [(a, b) for a in range(count) for b in range(a + 1, count)]


def likely_pairs(similarity: NDArray[np.float64], partners: int) -> list[tuple[int, int]]:
    """Each image with half of `partners` neighbours in its order and as many others most alike.

    Args:
        similarity: (N, N), of every two images.
        partners: about how many others an image is compared with.

    Returns:
        Pairs of numbers, the smaller first, in order.
    """
    count, near = len(similarity), max(1, partners // 4)  # on either side
    pairs = {(a, b) for a in range(count) for b in range(a + 1, min(a + near + 1, count))}
    others = similarity.copy()
    np.fill_diagonal(others, -np.inf)
    for a, b in pairs:
        others[a, b] = others[b, a] = -np.inf
    for a, row in enumerate(others):
        for b in np.argsort(-row, kind="stable")[: partners - 2 * near]:
            if np.isfinite(row[b]):
                pairs.add((min(a, int(b)), max(a, int(b))))
    return sorted(pairs)


def similarity(database: "pycolmap.Database", names: list[str]) -> NDArray[np.float64]:
    """How alike images are that a database of features holds, (N, N) from -1 to 1."""
    number_of = {image.name: image.image_id for image in database.read_all_images()}
    return vlad_similarity([_descriptors(database, number_of[name]) for name in names])


def _descriptors(database: "pycolmap.Database", number: int) -> NDArray[np.float32]:
    """RootSIFT (n, 128) of an image."""
    held = database.read_descriptors(number)  # its `data` is a view, which does not keep it
    return np.sqrt(np.array(held.data, dtype=np.float32))


def vlad_similarity(features: list[NDArray[np.float32]]) -> NDArray[np.float64]:
    """The cosines (N, N) between N images, each of any number of descriptors (., D)."""
    rng = np.random.default_rng(0)
    pool = np.concatenate(features)
    sample = pool[rng.permutation(len(pool))[:_SAMPLE]]
    words = min(_WORDS, len(sample))
    centers, _ = kmeans2(sample, words, iter=10, minit="points", rng=0)
    vectors = np.zeros((len(features), words, pool.shape[1]))
    for vector, descriptors in zip(vectors, features, strict=True):
        if len(descriptors):
            nearest, _ = vq(descriptors, centers)
            np.add.at(vector, nearest, descriptors - centers[nearest])
    vectors /= np.linalg.norm(vectors, axis=2, keepdims=True) + 1e-12  # no word outweighs others
    flat = vectors.reshape(len(features), -1)
    flat /= np.linalg.norm(flat, axis=1, keepdims=True) + 1e-12
    return flat @ flat.T
