"""`linkpose info`: the board, or a recording."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from linkpose.cli import options

if TYPE_CHECKING:
    from linkpose.cli.live import Console
    from linkpose.device.session import Health, Placement, Session
    from linkpose.wire.messages import HelloDevice, HelloMouse, Status

OBSERVED_S = 2.0  # of streaming: enough for the counts and a first figure of the drift


@click.command(name="info")
@click.argument("recording", type=options.FILE, required=False)
@options.port
@click.option("--self-test", is_flag=True, help="Also run the self-test of each inertial sensor; keep the board still.")
@options.as_json
@options.verbosity
def command(
    recording: Path | None, port: str | None, self_test: bool, json_lines: bool, verbose: bool, quiet: bool
) -> None:
    """Show the board's versions, sensors, settings and data health, which takes about three seconds, or summarise
    RECORDING: duration, rate, gaps, losses, invalid samples by cause, settings and noise at rest.
    """
    from linkpose.cli import live

    console = live.Console(quiet, verbose)
    if recording is not None:
        if port or self_test:
            raise click.UsageError(f"--port and --self-test ask the board: leave them out, or leave out {recording}")
        report = _summarise(recording, console)
    else:
        report = _ask_board(port, self_test, console)
    if json_lines:
        click.echo(json.dumps(report))
    else:
        console.clear()
        for line in _lines(report):
            click.echo(line)


def _summarise(path: Path, console: Console) -> dict[str, Any]:
    """The summary of a recording; its remarks go to stderr."""
    from linkpose.recording.reader import RecordingFile
    from linkpose.recording.summary import summarise

    file = RecordingFile(path, lambda share: console.progress(lambda: f"reading {path} {share:.0%}"))
    for remark in file.remarks:
        console.report(remark)
    return summarise(file)


def _ask_board(port: str | None, self_test: bool, console: Console) -> dict[str, Any]:
    """What the board reports, and the health of its sensors' data."""
    from linkpose.board import open_session

    with open_session(port, console.report) as session:
        session.wait_for_mice(0)
        tested = _self_tests(session) if self_test else {}
        sensors = _observe(session, console)
        return _report(session, session.health()) | {"health": sensors} | tested


def _observe(session: Session, console: Console) -> dict[str, Any]:
    """Stream for a short time; the state and counts of each sensor."""
    from linkpose.cli import live
    from linkpose.recorder import Recorder
    from linkpose.sensors.rig import Rig

    recorder = Recorder(session, None, Rig())

    def handle(placements: list[Placement]) -> None:
        recorder.convert(placements)
        console.progress(lambda: "observing the sensors ...")

    live.run(session.stream(OBSERVED_S), handle)
    return recorder.monitor.as_dict()


def _report(session: Session, health: Health) -> dict[str, Any]:
    from linkpose.device.answers import firmware_version, reset_causes
    from linkpose.sensors import devices

    hello, status = session.hello, health.status
    return {
        "port": session.port,
        "protocol": f"{hello.protocol_major}.{hello.protocol_minor}",
        "firmware": firmware_version(hello),
        "source_revision": devices.source_revision(hello),
        "reset_cause": reset_causes(hello),
        "sample_rate_hz": hello.sample_rate_hz,
        "sensors": devices.names(hello),
        "devices": [_device(device) for device in hello.devices],
        "accel_range_g": hello.accel_range_g,
        "gyro_range_deg_s": hello.gyro_range_deg_s,
        "dlpf": hello.dlpf,
        "baro_oversampling": hello.baro_oversampling,
        "mice": [_mouse(at, mouse) for at, mouse in enumerate(hello.mice, 1) if mouse.id != 0xFF],
        "samples": health.samples,
        "samples_lost": health.lost,
        "frames_corrupt": health.corrupt.total,
        "clock_drift_ppm": _rounded(health.drift_ppm),
        "clock_drift_std_ppm": _rounded(health.drift_std_ppm),
        "board": None if status is None else _counters(status, session.port),
    }


def _counters(status: Status, port: str) -> dict[str, Any]:
    """The board's own counters, except those of single devices; None for one that is not measured."""
    from linkpose.wire.messages import SCALES

    left_out = ("t_us", "devices", "mice", "loop_worst_us", "stack_free", "cpu_load", "vcc_mv")
    counters = {name: value for name, value in status._asdict().items() if name not in left_out}
    share = SCALES["STATUS.cpu_load"].scale
    of_processor = {
        "loop_worst_us": status.loop_worst_us,
        "stack_free_bytes": status.stack_free,
        "cpu_load_percent": round(100 * share * status.cpu_load, 1),
        "vcc_mv": status.vcc_mv or None,
    }
    # A simulated board has no processor.
    return counters | (dict.fromkeys(of_processor) if port.startswith("sim://") else of_processor)


def _device(device: HelloDevice) -> dict[str, Any]:
    """A sensor of the board: chip, where and with which id it answers, its state and what that means."""
    from linkpose.sensors import devices

    described = devices.describe(device)
    return {
        "chip": described.chip,
        "address": f"{device.address:#04x}",
        "id": f"{device.id:#04x}",
        "state": described.state,
        "remark": described.remark,
    }


def _mouse(port: int, mouse: HelloMouse) -> dict[str, Any]:
    """A mouse port: its state, the PS/2 id of the mouse, what it counts, and what it refused."""
    from linkpose.sensors import devices

    return {
        "port": port,
        "state": devices.mouse_state(mouse),
        "id": f"{mouse.id:#04x}",
        "counts_per_mm": mouse.counts_per_mm,
        "report_rate_hz": mouse.report_rate_hz,
        "refused": devices.refused_settings(mouse),
    }


def _self_tests(session: Session) -> dict[str, Any]:
    """The self-tests of the inertial sensors found. Raises LinkposeError if there is none."""
    from linkpose.sensors.devices import DEVICES, Sensors, found

    prefixes = {Sensors.MPU6050: "", Sensors.IMU2: "imu2_"}
    present = [sensor for sensor in prefixes if sensor & found(session.hello)] or [Sensors.MPU6050]
    report: dict[str, Any] = {}
    for sensor in present:
        tested = _self_test(session, DEVICES.index(sensor))
        report |= {f"{prefixes[sensor]}{name}": value for name, value in tested.items()}
    return report


def _self_test(session: Session, device: int) -> dict[str, Any]:
    """How far each axis is from the factory's response, and whether that is within the data sheet's limit."""
    from linkpose.sensors.mpu6050 import self_test_deviation, self_test_limit

    result = session.self_test(device)
    deviations = self_test_deviation(result)
    known = [deviation for deviation in deviations.values() if deviation is not None]
    verdict = "passed" if all(abs(deviation) <= self_test_limit(result) for deviation in known) else "failed"
    percent = {axis: None if value is None else round(100 * value, 1) for axis, value in deviations.items()}
    return {
        "self_test": verdict if known else "not known: the chip has no factory response",
        "self_test_deviation_percent": percent,
    }


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 1)


# Units at the end of a report's keys, as a person reads them.
_UNITS = {
    "_hz": "Hz", "_g": "g", "_rad_s": "rad/s", "_deg_s": "°/s", "_ppm": "ppm", "_percent": "%", "_us": "µs",
    "_mv": "mV", "_bytes": "bytes", "_m_s2": "m/s²", "_Pa": "Pa", "_s": "s", "_m": "m", "seconds": "s",
}  # fmt: skip


_MISSING = {"source_revision": "none (simulated board)"}  # what else than "not known" the absence of a value means


def _lines(report: dict[str, Any]) -> Iterator[str]:
    """The report for a person: one value a line with its unit, one device or mouse a line."""
    for name, value in report.items():
        label, unit = _label(name)
        if name == "devices":
            found = [device for device in value if device["state"] != "absent"]
            yield from _block("devices", [_device_line(device) for device in found] or ["none"])
        elif name == "mice" and value and "report_rate_hz" in value[0]:
            yield from _block("mice", [_mouse_line(mouse) for mouse in value])
        elif name == "health":
            shown = {sensor: of for sensor, of in value.items() if of["state"] != "absent"}
            yield from _block(
                "data health", [_health_line(sensor, of) for sensor, of in shown.items()] or ["no sensor"]
            )
        elif name == "remarks":
            continue  # they are on stderr
        elif isinstance(value, dict):
            yield from _block(label, [" ".join(filter(None, (*_item(key, item),))) for key, item in value.items()])
        elif isinstance(value, list) and any(isinstance(item, dict) for item in value):
            yield from _block(label, [_text(item) for item in value])
        else:
            missing = _MISSING.get(name, "not known")
            yield f"{label:20} " + (missing if value is None else f"{_text(value)} {unit}".rstrip())


def _block(label: str, lines: Sequence[str]) -> Iterator[str]:
    for at, line in enumerate(lines):
        yield f"{label if at == 0 else '':20} {line}"


def _label(name: str) -> tuple[str, str]:
    """A key without its unit, in words; the unit."""
    for ending, unit in _UNITS.items():
        if name.endswith(ending):
            return name.removesuffix(ending).replace("_", " "), unit
    return name.replace("_", " "), ""


def _item(name: str, value: Any) -> tuple[str, str, str]:
    if name == "family":
        return "", _family_name(value), ""
    label, unit = _label(name)
    return (label, _MISSING.get(name, "not measured"), "") if value is None else (label, _text(value), unit)


def _family_name(family: Any) -> str:
    """The chips of a family, or its number as the file has it."""
    from linkpose.wire.messages import DeviceFamily

    return next((known.name for known in DeviceFamily if known == family), _text(family))


def _device_line(device: dict[str, Any]) -> str:
    where = f"{device['chip']} at {device['address']} (id {device['id']}): {device['state']}"
    return f"{where}. {device['remark']}" if device["remark"] else where


def _mouse_line(mouse: dict[str, Any]) -> str:
    parts = [mouse["state"], f"{mouse['counts_per_mm']} counts/mm", f"{mouse['report_rate_hz']} reports/s"]
    parts += [f"refused {', '.join(mouse['refused'])}"] if mouse["refused"] else []
    return f"port {mouse['port']} (id {mouse['id']}): {', '.join(parts)}"


def _health_line(sensor: str, of: dict[str, Any]) -> str:
    counts = [f"{of['valid']} of {of['samples']} samples valid"] if "valid" in of else []
    counts += [f"{count} {cause}" for cause, count in of.get("invalid", {}).items()]
    counts += [f"{of['saturated']} saturated"] if of.get("saturated") else []
    counts += [f"{of['left_out']} left out"] if of.get("left_out") else []
    return f"{sensor} {of['state']}" + (f": {', '.join(counts)}" if counts else "")


def _text(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key.replace('_', ' ')} {_text(item)}" for key, item in value.items()) or "none"
    if isinstance(value, list):
        return ", ".join(map(_text, value)) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "not known" if value is None else str(value)
