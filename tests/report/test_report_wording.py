"""Numbers, units and names as printed."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bampipe.lists import count_noun, join_names
from bampipe.report import wording
from bampipe.report.document import split_spans


@pytest.mark.parametrize(
    ("stored", "shown"),
    [("N.m.s/rad", "N·m·s/rad"), ("m/s2", "m/s²"), ("kg.m2", "kg·m²"), ("", ""), ("1/s", "1/s")],
)
def test_unit(stored: str, shown: str) -> None:
    assert wording.format_unit(stored) == shown


@pytest.mark.parametrize(
    ("value", "sd", "shown"),
    [
        (4.1712, 0.1283, "4.17 ± 0.13"),
        (109020.3, 694.0, "109020 ± 694"),
        (-0.0513, 0.0042, "−0.0513 ± 0.0042"),
        (3.0, 0.0996, "3.00 ± 0.10"),
        (2.5, None, "2.500"),
        (2.5, 0.0, "2.500"),
        (None, 0.1, "–"),
        (float("nan"), 0.1, "–"),
        (-0.0001, 0.13, "0.00 ± 0.13"),
        (4.4e-6, 3.8e-6, "(4.4 ± 3.8)·10⁻⁶"),
        (-3e-7, 1.2e-5, "(0.0 ± 1.2)·10⁻⁵"),
        (2.134e-5, None, "2.134·10⁻⁵"),
        (1.1e-3, 2e-6, "0.0011000 ± 0.0000020"),
    ],
)
def test_with_sd(value: float | None, sd: float | None, shown: str) -> None:
    assert wording.format_with_sd(value, sd) == shown


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e4))
def test_rounding_stays_within_a_twentieth_of_the_uncertainty(value: float, sd: float) -> None:
    both, _, raised = wording.format_with_sd(value, sd).replace("−", "-").partition(")·10")
    shown = [10.0 ** read_power(raised) * float(x) for x in both.strip("()").split(" ± ")]
    assert abs(shown[0] - value) <= 0.0505 * sd + 1e-9 * abs(value)
    assert abs(shown[1] - sd) <= 0.0505 * sd


def read_power(raised: str) -> int:
    return int("".join("-0123456789"["⁻⁰¹²³⁴⁵⁶⁷⁸⁹".index(mark)] for mark in raised) or "0")


@given(st.floats(1e-9, 1e9))
def test_significant_keeps_three_digits(value: float) -> None:
    text = wording.format_digits(value)
    if "·10" in text:
        mantissa, raised = text.split("·10")
        shown = float(mantissa) * 10.0 ** read_power(raised)
    else:
        shown = float(text)
    assert shown == pytest.approx(value, rel=5.01e-3)


@pytest.mark.parametrize(
    ("values", "base", "shown"),
    [
        ([2304.2], "N.m/rad", (1e-3, "kN·m/rad")),
        ([47e-6], "rad", (1e6, "µrad")),
        ([0.0009], "m", (1e3, "mm")),
        ([0.5], "m/s", (1.0, "m/s")),
        ([500.0], "N", (1.0, "N")),
        ([3500.0], "kg", (1.0, "kg")),
        ([0.0], "m", (1.0, "m")),
        ([1e-9], "m", (1e6, "µm")),
    ],
)
def test_scale(values: list[float], base: str, shown: tuple[float, str]) -> None:
    factor, unit = wording.choose_scale(values, base)
    assert factor == pytest.approx(shown[0])
    assert unit == shown[1]


def test_names_in_words() -> None:
    assert wording.name_parameter("viscous.yaw") == "Viscous damping, yaw"
    assert wording.name_parameter("gravity_compensator_lag.time") == "Gravity compensator lag, time"
    assert join_names(["a", "b", "c"]) == "a, b and c"
    assert join_names(["a"]) == "a"
    assert count_noun(1, "trial") == "1 trial"
    assert count_noun(2, "trial") == "2 trials"
    assert wording.format_p_value(0.0002) == "< 0.001"
    assert wording.format_percent(0.812) == "81 %"


@pytest.mark.parametrize(
    ("stored", "printed"),
    [
        ("fell by 0.2 N.m. Done", "fell by 0.2 N·m. Done"),
        ("19 N.m.s/rad, 2 kg.m2 and 3 rad/s2", "19 N·m·s/rad, 2 kg·m² and 3 rad/s²"),
        ("bumps of -1.1 N and +1.2 N (-0.5 to -2)", "bumps of −1.1 N and +1.2 N (−0.5 to −2)"),
        ("0.0018 ± 1.6e-05 N.m", "0.0018 ± 1.6·10⁻⁵ N·m"),
        ("trial t-01 of 2026-10-03, I_yy - I_zz", "trial t-01 of 2026-10-03, I_yy - I_zz"),
    ],
)
def test_prose_has_printed_numbers_and_leaves_names_alone(stored: str, printed: str) -> None:
    assert wording.format_prose(stored) == printed


def test_code_is_printed_as_it_is_to_be_typed() -> None:
    assert split_spans("by -2 with `--set x=-2`") == [
        ("plain", "by −2 with "),
        ("code", "--set x=-2"),
    ]
