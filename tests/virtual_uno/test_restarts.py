"""Why the board started, behind each bootloader: a cause is reported only where the bootloader leaves evidence."""

from __future__ import annotations

from pathlib import Path

import pytest
from bootloader import ATMEGABOOT, build_optiboot, programmed
from wire_link import WireLink

from linkpose.wire.messages import Hello, ResetCause
from virtual_uno import VirtualUno

NOT_HUNG = 0xFFFF
HUNG = ResetCause.HUNG | ResetCause.WATCHDOG
EXTERNAL = ResetCause.EXTERNAL


@pytest.mark.parametrize(
    ("version", "after_external_reset", "after_watchdog_reset"),
    [
        # Clears MCUSR and passes nothing.
        ("4.4", ResetCause(0), ResetCause(0)),
        # Passes MCUSR in r2, and ends its own wait with a watchdog reset: that one proves nothing.
        ("6.2", ResetCause(0), ResetCause(0)),
        # Leaves MCUSR alone.
        ("8", EXTERNAL, ResetCause.WATCHDOG),
        # Leaves MCUSR and the watchdog alone: a watchdog reset would repeat for ever.
        ("ATmegaBOOT", EXTERNAL, None),
    ],
)
def test_reset_causes(
    tmp_path: Path,
    firmware_hex: Path,
    version: str,
    after_external_reset: ResetCause,
    after_watchdog_reset: ResetCause | None,
) -> None:
    old = version == "ATmegaBOOT"
    bootloader = ATMEGABOOT if old else build_optiboot(tmp_path, resets=version)
    program = programmed(tmp_path, firmware_hex, bootloader).path
    with VirtualUno(program, boot_address=bootloader.address, seed=5) as uno:
        link = WireLink(uno)
        assert link.expect(Hello, 4000).reset_cause & ~(ResetCause.POWER_ON | after_external_reset) == 0
        for _ in range(2):
            uno.reset()
            hello = link.expect(Hello, 4000)
            assert (hello.reset_cause & ~ResetCause.POWER_ON, hello.hung_at) == (after_external_reset, NOT_HUNG)
        uno.watch(["reset"])
        at = uno.hang(interrupts=True)
        hello = link.expect(Hello, 1200)
        assert (hello.reset_cause, hello.hung_at) == (HUNG, at)
        assert len(uno.events()) == 0
        if after_watchdog_reset is not None:
            uno.hang()
            hello = link.expect(Hello, 2500)
            assert (hello.reset_cause, hello.hung_at) == (after_watchdog_reset, NOT_HUNG)
