"""No reachable state emits without key, interlock, heartbeat and freedom from fault, or above a ceiling."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import Phase, settings
from hypothesis.stateful import RuleBasedStateMachine, run_state_machine_as_test

from firmware_iface.virtual.i2c import safety_controller as model
from tests.firmware_iface.lasers.failing_bus import FailingBus
from tests.firmware_iface.lasers.hostile_host import HostileHost, Judge


def test_a_hostile_host_gets_no_light_that_it_should_not() -> None:
    before = Judge.emitting
    run_state_machine_as_test(
        HostileHost, settings=settings(max_examples=150, stateful_step_count=30, deadline=None)
    )
    assert Judge.emitting - before > 2000, "the board hardly ever emitted, so little was judged"


def constant(name: str, value: object) -> Callable[[pytest.MonkeyPatch], None]:
    return lambda patch: patch.setattr(model, name, value)


def ceiling_again(patch: pytest.MonkeyPatch) -> None:
    def set_ceiling(self: model.SafetyController, kind: int, laser: int, value: int) -> None:
        self.ceilings[laser][kind] = value

    patch.setattr(model.SafetyController, "_set_ceiling", set_ceiling)


def deaf_to(fault: model.Fault) -> Callable[[pytest.MonkeyPatch], None]:
    latch = model.SafetyController._latch

    def breaks(patch: pytest.MonkeyPatch) -> None:
        patch.setattr(
            model.SafetyController, "_latch", lambda self, f: latch(self, f & ~fault) if f & ~fault else None
        )

    return breaks


def gate_of_arming_alone(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(model.SafetyController, "gate", property(lambda self: self.armed))
    patch.setattr(model.SafetyController, "_watch", lambda self: None)


def no_limiter(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(model.SafetyController, "output_v", lambda self, laser: self._wiring.requested_v(laser))


@pytest.mark.parametrize(
    "breaks",
    [
        constant("WINDOW_S", 0.15),
        constant("RISE_TICKS", 25),
        constant("pec", lambda data: 0x00),
        ceiling_again,
        deaf_to(model.Fault.HEARTBEAT),
        pytest.param(deaf_to(model.Fault.INTERLOCK), marks=pytest.mark.slow),
        deaf_to(model.Fault.HOST),
        deaf_to(model.Fault.OVERPOWER_0 | model.Fault.OVERPOWER_1 | model.Fault.OVERPOWER_2),
        deaf_to(model.Fault.BUS),
        gate_of_arming_alone,
        no_limiter,
    ],
    ids=[
        "window",
        "rise",
        "code",
        "ceiling",
        "heartbeat",
        "interlock",
        "host",
        "overpower",
        "bus",
        "gate",
        "limiter",
    ],
)
def test_the_judge_sees_a_controller_that_is_broken(
    breaks: Callable[[pytest.MonkeyPatch], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    breaks(monkeypatch)
    with pytest.raises(AssertionError):
        run_state_machine_as_test(
            HostileHost,
            settings=settings(
                max_examples=2000,
                stateful_step_count=30,
                deadline=None,
                derandomize=True,
                phases=[Phase.generate],
                report_multiple_bugs=False,
            ),
        )


def test_no_failure_of_bus_board_or_program_leaves_light() -> None:
    run_state_machine_as_test(
        FailingBus, settings=settings(max_examples=60, stateful_step_count=30, deadline=None)
    )


@pytest.mark.slow
@pytest.mark.parametrize("machine", [HostileHost, FailingBus])
def test_the_same_for_long(machine: type[RuleBasedStateMachine]) -> None:
    run_state_machine_as_test(
        machine, settings=settings(max_examples=1000, stateful_step_count=50, deadline=None)
    )
