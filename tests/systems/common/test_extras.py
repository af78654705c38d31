import pytest

from splatpilot.systems.common.extras import import_extra, missing_extra


def test_missing_package_says_which_extra_brings_it():
    """What is installed is imported; what is not names itself and the command that installs it."""
    assert import_extra("json", "train").loads("1") == 1
    message = r"^absent_package is not installed; pip install 'splatpilot\[photos\]'$"
    with pytest.raises(ModuleNotFoundError, match=message) as caught:
        import_extra("absent_package.part", "photos")
    assert caught.value.name == "absent_package"


@pytest.mark.parametrize(
    ("package", "extra"),
    [
        ("torch", "train"),
        ("torchvision", "train"),
        ("pycolmap", "photos"),
        ("gsplat", "cuda"),
        ("distributed", "cluster"),
        ("tensorboard", "tensorboard"),
    ],
)
def test_missing_extra_names_the_one_that_brings_a_package(package, extra):
    """Each optional package is brought by one extra, and the sentence names it."""
    error = ModuleNotFoundError(name=package)
    expected = f"reconstruct needs {package}; pip install 'splatpilot[{extra}]'"
    assert missing_extra(error, "reconstruct") == expected


@pytest.mark.parametrize("package", ["numpy", "absent_package", None])
def test_no_extra_brings_what_flying_needs(package):
    """What is always installed, and what we never use, belongs to no extra."""
    assert missing_extra(ModuleNotFoundError(name=package), "reconstruct") is None
