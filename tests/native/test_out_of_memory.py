import subprocess
import sys

PROGRAM = """
import resource
import numpy as np
from pydrake.math import RigidTransform
from splatpilot.systems.splats.baked_scene import BakedScene, create_renderer
from splatpilot.systems.splats.scene import GaussianScene

K = np.array([[100.0, 0, 50], [0, 100.0, 50], [0, 0, 1]])
SMALL = K, 64, 48, RigidTransform()
means = np.random.default_rng(0).normal(size=(15_000, 3)) + [0, 0, 5]
ones = np.ones((len(means), 1))
scene = GaussianScene.from_colors(
    means, ones * [1, 0, 0, 0], ones * [50, 50, 50], 0.5 * ones[:, 0], ones * [1, 0.5, 0.2]
)
baked = BakedScene(scene, threads=4)
before = baked.render(*SMALL)
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + (600 << 20), resource.RLIM_INFINITY))
try:
    # 16,384 tiles, each touched by all Gaussians: 3 GB of pairs.
    baked.render(K, 2048, 2048, RigidTransform())
except MemoryError:
    print("MemoryError")
try:
    create_renderer(1024)
except OSError as error:
    print(error)
for renderer in (baked, BakedScene(scene, threads=2)):
    print(all(map(np.array_equal, before, renderer.render(*SMALL))))
"""


def test_frames_and_threads_beyond_memory_are_errors_that_leave_renderers_usable():
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True)
    assert done.returncode == 0, f"{done.returncode}: {done.stderr}"
    frame, threads, *usable = done.stdout.splitlines()
    assert frame == "MemoryError"
    assert "of 1024 threads could be started" in threads and "fewer threads" in threads
    assert usable == ["True", "True"]
