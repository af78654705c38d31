import subprocess
import sys

LIMITED = """
import resource
import numpy as np
from pydrake.math import RigidTransform
from splatpilot.systems.splats.baked_scene import BakedScene, create_renderer
from splatpilot.systems.splats.scene import GaussianScene

def scene(count):
    g = np.random.default_rng(0)
    means = g.normal(size=(count, 3)) + [0, 0, 5]
    ones = np.ones((count, 1))
    return GaussianScene.from_colors(
        means, ones * [1, 0, 0, 0], ones * [50, 50, 50], 0.5 * ones[:, 0], ones * [1, 0.5, 0.2]
    )

def limit_growth(mebibytes):
    used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (mebibytes << 20), resource.RLIM_INFINITY))

K = np.array([[100.0, 0, 50], [0, 100.0, 50], [0, 0, 1]])
"""
FRAME = """
baked = BakedScene(scene(40_000), threads=4)
small = (K, 64, 48, RigidTransform())
before = baked.render(*small)
limit_growth(600)
try:
    # 16,384 tiles, each touched by all Gaussians: 7 GB of pairs.
    baked.render(K, 2048, 2048, RigidTransform())
except MemoryError:
    print("MemoryError")
after = baked.render(*small)
print(all(np.array_equal(a, b) for a, b in zip(before, after)))
"""
THREADS = """
limit_growth(600)
try:
    create_renderer(1024)
except OSError as error:
    print(error)
print(BakedScene(scene(10), threads=2).render(K, 8, 8, RigidTransform()).alpha.shape)
"""


def run(program: str) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", LIMITED + program], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{done.returncode}: {done.stderr}"
    return done.stdout.splitlines()


def test_frame_beyond_memory_is_an_error_that_leaves_the_renderer_usable():
    assert run(FRAME) == ["MemoryError", "True"]


def test_threads_that_cannot_be_started_are_an_error():
    message, shape = run(THREADS)
    assert "of 1024 threads could be started" in message and "fewer threads" in message
    assert shape == "(8, 8)"
