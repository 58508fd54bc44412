"""linkpose info"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import click

from linkpose.cli import options

if TYPE_CHECKING:
    from linkpose.device.session import Health, Session

OBSERVED_S = 2.0  # of streaming: enough for the counts and a first figure of the drift


@click.command(name="info")
@options.port
@click.option("--self-test", is_flag=True, help="Also run the MPU-6050's self-test; keep the board still.")
@options.as_json
@options.verbosity
def command(port: str | None, self_test: bool, json_lines: bool, verbose: bool, quiet: bool) -> None:
    """Show the board's versions, sensors, settings and link health. Takes about three seconds."""
    from linkpose.cli import live
    from linkpose.device.ports import choose_port
    from linkpose.device.session import Session

    console = live.Console(quiet, verbose)
    with Session(port or choose_port(), console.say) as session:
        tested = _self_test(session) if self_test else {}
        live.run(session, OBSERVED_S, 0, lambda _: console.progress(lambda: "observing the link ..."))
        report = _report(session, session.health()) | tested
    if json_lines:
        click.echo(json.dumps(report))
    else:
        console.clear()
        for name, value in report.items():
            click.echo(f"{name.replace('_', ' '):18} {_text(value)}")


def _report(session: Session, health: Health) -> dict[str, Any]:
    from linkpose.device.session import firmware_version, reset_causes
    from linkpose.wire.messages import Sensors

    hello, status = session.hello, health.status
    return {
        "port": session.port,
        "protocol": f"{hello.protocol_major}.{hello.protocol_minor}",
        "firmware": firmware_version(hello),
        "source_revision": f"{hello.source_revision:08x}",
        "reset_cause": reset_causes(hello),
        "sample_rate_hz": hello.sample_rate_hz,
        "sensors": [s.name.lower() for s in Sensors if hello.sensors & s and s.name],
        "imu_id": f"{hello.imu_id:#04x}",
        "accel_range_g": hello.accel_range_g,
        "gyro_range_deg_s": hello.gyro_range_deg_s,
        "dlpf": hello.dlpf,
        "baro_oversampling": hello.baro_oversampling,
        "mice": [{"port": at, **mouse._asdict()} for at, mouse in enumerate(hello.mice, 1) if mouse.id != 0xFF],
        "samples": health.samples,
        "samples_lost": health.lost,
        "frames_corrupt": health.corrupt.total,
        "clock_drift_ppm": _rounded(health.drift_ppm),
        "clock_drift_std_ppm": _rounded(health.drift_std_ppm),
        "board": None if status is None else {k: v for k, v in status._asdict().items() if k not in ("t_us", "mice")},
    }


def _self_test(session: Session) -> dict[str, Any]:
    """How far each axis is from the factory's answer, and whether that is within the data sheet's limit."""
    from linkpose.sensors.mpu6050 import SELF_TEST_LIMIT, self_test_deviation

    deviations = self_test_deviation(session.self_test())
    known = [deviation for deviation in deviations.values() if deviation is not None]
    passed = bool(known) and all(abs(deviation) <= SELF_TEST_LIMIT for deviation in known)
    percent = {axis: None if value is None else round(100 * value, 1) for axis, value in deviations.items()}
    return {"self_test": "passed" if passed else "failed", "self_test_deviation_percent": percent}


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 1)


def _text(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(_text(item) for item in value) or "none"
    if isinstance(value, dict):
        return ", ".join(f"{key.replace('_', ' ')} {item}" for key, item in value.items())
    return "not known" if value is None else str(value)
