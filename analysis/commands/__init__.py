"""The commands of `splatpilot`. A module is imported when one of its commands is called."""

COMMANDS = {
    "fly": ("flight", "fly to a goal and write a page, a video and a trajectory"),
    "view": ("flight", "view a scene, a map, a capture or a generated world, and measure in it"),
    "benchmark": ("benchmark", "fly policies through scenarios many times, and report"),
    "replay": ("benchmark", "fly one flight of a study again, and check it"),
    "difficulty": ("benchmark", "print how hard scenarios are, and how many seeds are feasible"),
    "reconstruct": (
        "capture",
        "make a scene to fly in from a capture, a mesh or a generated world",
    ),
    "capture": ("", "render a capture, or check one"),
    "capture check": ("capture", "check that poses, intrinsics and depth of a capture agree"),
    "capture render": (
        "capture",
        "render a capture of a mesh or a generated world, with exact depth",
    ),
    "scene": ("", "scale, measure, export or compare scenes"),
    "scene scale": (
        "scene",
        "scale a scene by a factor, a measured length, or the height of the cameras",
    ),
    "scene measure": ("scene", "compare a scene with the held-out frames of its capture"),
    "scene mesh": (
        "scene",
        "write the surfaces of a scene, a map or a generated world as a mesh for collisions",
    ),
    "scene ablate": (
        "scene",
        "reconstruct captures with increasing use of depth, as 3DGS and 2DGS, and compare",
    ),
    "scene fidelity": (
        "scene",
        "measure how far from its capture's path a scene can be trusted",
    ),
    "scene twin": (
        "scene",
        "measure how well flights in scenes predict flights in the meshes that they show",
    ),
    "gap": ("scene", "compare what policies decide by photographs and by renderings"),
    "library": ("", "make and list the environments of a folder of data"),
    "library make": ("capture", "reconstruct, measure and record environments"),
    "library show": ("capture", "print the recorded environments, and draw each"),
    "library pack": ("capture", "write recorded scenes in a form to be shared"),
    "library get": ("capture", "copy packed scenes from a folder or a file server"),
    "train": ("train", "train policies"),
    "recover": (
        "train",
        "train a student, fly it, and train it again with corrections of its near-misses",
    ),
    "corpus": ("", "collect samples for students, inspect or export them"),
    "corpus make": (
        "train",
        "fly the expert through many worlds and record images and labels",
    ),
    "corpus inspect": ("train", "draw samples with their trajectories, and check every byte"),
    "corpus export": ("train", "write the flights as a LeRobotDataset"),
    "hardware": ("", "fly vehicles, real or simulated, by messages"),
    "hardware vehicle": ("flight", "simulate a vehicle that is flown by LCM messages"),
    "hardware bridge": ("flight", "fly a vehicle, real or simulated, by LCM messages"),
    "hardware px4": ("flight", "connect the bridge to PX4 by MAVLink"),
    "hardware faults": ("flight", "fly with faults of messages, clocks and policies"),
    "doctor": (
        "doctor",
        "list what works on this machine, and what to install or set for the rest",
    ),
    "headlines": ("doctor", "measure the documented speeds on this machine"),
}
"""Module and help of each command, in the order of the help; "" of those with subcommands."""
