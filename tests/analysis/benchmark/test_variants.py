"""Policies of a study as they are written."""

import pytest

from splatpilot.analysis.benchmark.variants import Variant, parse_variant, split_policies, sweep
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK
from splatpilot.systems.policies.reactive import ReactiveConfig


@pytest.mark.parametrize(
    ("text", "variant"),
    [
        ("reactive", Variant("reactive", "reactive")),
        ("fast=reactive", Variant("fast", "reactive")),
        ("fast=reactive:margin=0.2", Variant("fast", "reactive", ("margin=0.2",))),
        ("reactive:margin=0.2", Variant("reactive-margin-0.2", "reactive", ("margin=0.2",))),
        (
            "planner:lattice.jerk=1:rate=10",
            Variant("planner-lattice.jerk-1-rate-10", "planner", ("lattice.jerk=1", "rate=10")),
        ),
        ("out/mine.npz", Variant("mine", "out/mine.npz")),
        ("a=out/x=y:z/m.npz:rate=3", Variant("a", "out/x=y:z/m.npz", ("rate=3",))),
        ("others.policies:Mine", Variant("Mine", "others.policies:Mine")),
        ("m=others:Mine:gain=2", Variant("m", "others:Mine", ("gain=2",))),
        ("r=reactive:camera={width: 32}", Variant("r", "reactive", ("camera={width: 32}",))),
    ],
)
def test_variants_are_read(text, variant):
    assert parse_variant(text) == variant


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a/b=reactive", "labeled 'a/b', but labels name files"),
        (".=reactive", "labeled '.'"),
        ("=reactive", "'=reactive' has no label before its ="),
        ("reactive:yaws=[1, 2]", r"LABEL=POLICY"),
        ("x" * 81 + "=reactive", "at most 80"),
        ("a=reactive:speed=3", "must not set speed; give the speed of all policies"),
        (
            "a=planner:lattice.speed=3",
            "must not set speed; give the speed of all policies",
        ),
        ("a=diffaero:weights=x.npz", "LABEL=FILE.npz"),
        ("../mine.py", r"a policy must be .*, got \.\./mine\.py; .* write mine:CLASS"),
    ],
)
def test_bad_variants_are_refused(text, message):
    with pytest.raises(ValueError, match=message):
        parse_variant(text)


def test_variant_changes_the_fields_it_names():
    config = parse_variant("wide=reactive:margin=0.4:camera.width=32").config(1.5, None)
    assert isinstance(config, ReactiveConfig)
    assert (config.speed, config.margin, config.camera.width) == (1.5, 0.4, 32)
    assert config.camera.height == ReactiveConfig().camera.height
    own = ReactiveConfig(margin=0.1, speed=3.0)
    assert parse_variant("scenario").config(2.0, own) == own
    assert parse_variant("o=scenario:margin=0.3").config(2.0, own).margin == 0.3
    assert own.margin == 0.1


def test_variant_of_a_file_flies_by_its_weights(tmp_path):
    shipped = PolicyCheckpoint.load("", "diffaero", DIFFAERO_NETWORK)
    file = tmp_path / "mine.npz"
    PolicyCheckpoint("diffaero", shipped.spec, dict(shipped.weights), {}).save(file)
    variant = parse_variant(f"near={file}:camera.max_depth=8")
    assert (variant.label, variant.weights) == ("near", file)
    config = variant.config(2.0, None)
    assert (config.weights, config.camera.max_depth) == (str(file), 8.0)


def test_lists_are_split_outside_brackets():
    assert split_policies("a, b=c:x=[1,2]:y={z: 1,w: 2},d") == [
        "a",
        "b=c:x=[1,2]:y={z: 1,w: 2}",
        "d",
    ]


def test_sweep_is_all_combinations():
    assert list(sweep("reactive:margin=0.1,0.2")) == [
        "reactive:margin=0.1",
        "reactive:margin=0.2",
    ]
    labels = [parse_variant(text).label for text in sweep("planner:rate=5,10:lattice.k=1,2,3")]
    assert len(set(labels)) == 6
    assert labels[4] == "planner-rate-10-lattice.k-2"
    with pytest.raises(ValueError, match="has no field"):
        list(sweep("reactive"))
