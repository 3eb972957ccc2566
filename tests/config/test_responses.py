"""Pads with a response instead of a sheet with electrodes, in the deployment file."""

from __future__ import annotations

import pytest

from handtouch.config import ConfigError, Deployment, load, parse, shipped
from handtouch.config.roles import channel_count

TEXT = shipped.path("taxels.toml").read_text()


def problems(text: str) -> str:
    with pytest.raises(ConfigError) as error:
        parse(text)
    return str(error.value)


def test_channels_are_named_by_the_response_and_no_sheet_is_needed() -> None:
    deployment = load(shipped.path("taxels.toml"))
    tip, middle = (entry.pad for entry in deployment.pads)
    assert tip.electrode_names == tip.electrodes == tuple(f"t{k}" for k in range(1, 10))
    assert len(middle.electrode_names) == channel_count(middle) == 5
    assert deployment.sheets == {}
    assert deployment.sheet_of(tip).alpha == 1.0


def test_a_recorded_deployment_with_responses_reads_back_the_same() -> None:
    deployment = parse(TEXT)
    assert Deployment.model_validate_json(deployment.model_dump_json(by_alias=True)) == deployment


def test_a_response_may_stand_in_the_pad_itself() -> None:
    table = '{ kind = "taxels", positions_mm = [[-4, -4], [4, -4], [0, 4]], width_mm = 4, signal_per_n = 1 }'
    channels = 'channels = ["0x6401:1", "0x6401:2", "0x6401:3"]'
    text = TEXT.replace('response = "cells"', f"response = {table}")
    start = text.index("[node.nine_channel]\n") + len("[node.nine_channel]\n")
    text = text[:start] + channels + text[text.index("\n", start) :]
    assert parse(text).pads[0].pad.electrode_names == ("t1", "t2", "t3")


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ('response = "cells"', 'response = "cell"', 'no [response.NAME] of that name; did you mean "cells"?'),
        ("width_mm = 3.0", "width_mm = [3.0, 3.0, 3.0]", "needs 9 values, one for each taxel"),
        ("width_mm = 3.0", "widht_mm = 3.0", 'did you mean "width_mm"?'),
        ('kind = "taxels"\npositions', 'kind = "taxel"\npositions', "must be"),
        ("[-5.0, -5.0], [0.0", "[-50.0, -5.0], [0.0", "hardly responds anywhere on the pad"),
        ("[-5.0, -5.0], [0.0", "[-5.0, -5.0, 0.0], [0.0", "all must have two numbers"),
        ('response = "cells"', 'response = "cells"\ngap_mm = 1.0', "leave it out"),
        ('response = "cells"', 'response = "barometers"', "has 9 channels, the pad 5 electrodes"),
        ('unit = "N"\nfull_scale = 32.767', "drive_v = 5\nfull_scale_ma = 10", "give it unit and full_scale"),
        ('unit = "N"\nfull_scale = 32.767', "full_scale = 32.767", "goes with unit"),
        ("full_scale = 32.767", "full_scale = 32.767\nfull_scale_ma = 10.0", "leave one of them out"),
    ],
)  # fmt: skip
def test_mistakes_name_their_remedy(old: str, new: str, found: str) -> None:
    assert found in problems(TEXT.replace(old, new, 1))


def test_a_pad_still_needs_a_sheet_without_a_response() -> None:
    text = problems(TEXT.replace('response = "cells"\n', "", 1))
    assert "sheet" in text
    assert "gap_mm" in text
