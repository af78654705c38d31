"""Commands ended in the middle; `make crash` does it to more of them, and more often."""

import pytest

from crash.campaign import Campaign


@pytest.fixture(scope="module")
def campaign(tmp_path_factory) -> Campaign:
    return Campaign(tmp_path_factory.mktemp("crash"))


@pytest.mark.parametrize("way", ["SIGTERM", "full disk"])
def test_flight_that_is_ended_loses_nothing(campaign, way):
    """A flight ended in any way answers in one line, leaves nothing behind, and the same command
    again leaves the same as if it had not been ended."""
    assert campaign.round("fly", way, seed=3).wrong == ""
