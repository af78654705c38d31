"""The commands of `splatpilot`. They import torch and pydrake when they run: that takes seconds."""

from splatpilot.analysis.commands import benchmark, capture, doctor, flight, hardware, scene, train
from splatpilot.analysis.commands.options import Command

COMMANDS = (
    *(flight.fly, flight.view, benchmark.benchmark, benchmark.replay, benchmark.difficulty),
    capture.reconstruct,
    Command("capture", "render a capture, or check one"),
    *(capture.check, capture.render),
    Command("scene", "scale, measure, export, compare or fetch scenes"),
    *(scene.scale, scene.measure, scene.mesh, scene.ablate, scene.fidelity, scene.fetch),
    *(train.train, train.recover),
    Command("corpus", "collect samples for students, or inspect them"),
    *(train.make_corpus, train.inspect_corpus),
    Command("hardware", "fly vehicles, real or simulated, by messages"),
    *(hardware.vehicle, hardware.bridge, hardware.px4, hardware.faults),
    doctor.doctor,
)
"""In the order of the help; subcommands follow their command."""

MOVED = {
    "tour": "reconstruct",
    "merge": "benchmark --cluster",
    "places": "scene fetch",
    **{name: f"scene {name}" for name in ("scale", "measure", "mesh", "ablate", "fidelity")},
    **{name: f"hardware {name}" for name in ("vehicle", "bridge", "px4", "faults")},
}
"""New names of commands that have moved."""
