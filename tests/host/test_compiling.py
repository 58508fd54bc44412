"""Machine code is kept from run to run, and never used with other sources than its own."""

from __future__ import annotations

import math
import os
import shutil
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, get_args

import pytest

from linkpose import compiling, filters, precompile
from linkpose.localization.localizer import Method

HOST = Path(__file__).parents[2] / "host"

# A compiled function whose machine code includes what it calls in another file, and a class in its signature.
HEIGHT = """
from linkpose import filters
from linkpose.filters import baro
from linkpose.sensors.rig import Rig
estimate = baro.BaroFilter(Rig().with_j2s((0.0, 0.0, 1.5))).process(filters._two_samples_at_rest())
print(round(estimate[0, 0] * 9.8 / 9.8, 9), sum(baro._process.stats.cache_hits.values()))
"""
# A compiled function that takes a fifth of the time to compile.
TEXT = """
import numpy as np
from linkpose.recording import fixedpoint
text = fixedpoint.format_rows(np.array([[1.25]]), np.array([2]))
print(text.decode().strip(), sum(fixedpoint._format.stats.cache_hits.values()))
"""


@pytest.fixture
def package(tmp_path) -> Path:
    """A copy of the package, to be edited."""
    ignored = shutil.ignore_patterns("__pycache__")
    return Path(shutil.copytree(HOST / "linkpose", tmp_path / "host" / "linkpose", ignore=ignored))


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    """What is kept goes here."""
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache" / "linkpose"


def run(code: str, host: Path, **environment: object) -> str:
    changed = {"PYTHONPATH": host, "PYTHONDONTWRITEBYTECODE": 1, **environment}
    everything = {**os.environ, **{name: str(value) for name, value in changed.items()}}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=everything)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


def test_an_edit_in_another_file_and_a_renamed_class_are_seen(package, tmp_path):
    host, place = package.parent, {"NUMBA_CACHE_DIR": tmp_path / "cache"}
    assert run(HEIGHT, host, **place) == "1.5 0"
    assert run(HEIGHT, host, **place) == "1.5 1"
    edit(package / "filters" / "_vector.py", "return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]", "return 4.0")
    assert run(HEIGHT, host, **place) == "2.0 0"
    edit(package / "filters" / "baro.py", "BaroParameters", "Parameters")
    assert run(HEIGHT.replace("BaroParameters", "Parameters"), host, **place) == "2.0 0"


def test_the_compiler_itself_and_each_source_of_machine_code_change_the_folder(package, cache, monkeypatch):
    folders = {compiling.cache_folder(package)}
    for name in ("filters/_vector.py", "localization/models/se2.py", "sensors/mpu6050.py", "wire/messages.py"):
        edit(package / name, "from __future__", "# edited\nfrom __future__")
        folders.add(compiling.cache_folder(package))
    monkeypatch.setattr("numba.__version__", "0.0")
    folders.add(compiling.cache_folder(package))
    edit(package / "cli" / "plot.py", "from __future__", "# edited\nfrom __future__")
    folders.add(compiling.cache_folder(package))
    assert len(folders) == 6


def test_all_that_compiled_modules_import_of_this_package_is_among_the_sources():
    code = (
        "import importlib, pathlib, sys, linkpose.compiling as c\n"
        "for path in c._PACKAGE.rglob('*.py'):\n"
        "    if 'from linkpose.compiling import' in path.read_text('utf-8'):\n"
        "        importlib.import_module('.'.join(path.relative_to(c._PACKAGE.parent).with_suffix('').parts))\n"
        "known = {str(path) for pattern in c._SOURCES for path in c._PACKAGE.glob(pattern)}\n"
        "used = {m.__file__ for name, m in sys.modules.items() if name.split('.')[0] == 'linkpose'}\n"
        "print(len(used) > 40, sorted(used - known))"
    )
    assert run(code, HOST) == "True []"


def test_only_the_compilers_modules_ask_numba():
    asking = [
        path.relative_to(HOST).as_posix()
        for path in HOST.rglob("*.py")
        if any(line.startswith(("import numba", "from numba")) for line in path.read_text("utf-8").splitlines())
    ]
    assert sorted(asking) == [f"linkpose/{name}.py" for name in ("compiling", "lean_compiler", "lean_lowering")]


def test_folders_out_of_use_are_removed_and_nothing_else(package, cache):
    def edited(number: int) -> Path:
        edit(package / "errors.py", "from __future__", f"# {number}\nfrom __future__")
        folder = compiling.cache_folder(package)
        assert folder is not None
        (folder / "filters").mkdir(exist_ok=True)
        os.utime(folder, (number, number))
        return folder

    cache.mkdir(parents=True)
    (cache / "notes").mkdir()
    folders = [edited(number) for number in range(3)]
    assert compiling.cache_folder(package) == folders[2]
    os.utime(folders[0], (10, 10))  # used again
    newest = edited(20)
    assert set(cache.iterdir()) == {cache / "notes", folders[0], folders[2], newest}


def test_processes_that_start_together_share_the_folder(package, cache):
    with ThreadPoolExecutor(8) as pool:
        folders = list(pool.map(lambda _: compiling.cache_folder(package), range(40)))
    assert set(folders) == set(cache.iterdir()) == {folders[0]}


def test_where_nothing_can_be_written_the_steps_run_all_the_same(package, tmp_path):
    (tmp_path / "file").touch()
    nowhere = tmp_path / "file" / "below"
    shutil.rmtree(package / "__pycache__", ignore_errors=True)
    (package / "__pycache__").touch()
    places = dict.fromkeys(("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME", "LOCALAPPDATA", "USERPROFILE"), nowhere)
    before = set(tmp_path.rglob("*"))
    assert run(TEXT, package.parent, **places) == "1.25 0"
    assert set(tmp_path.rglob("*")) == before


def test_a_home_that_cannot_be_written_leaves_the_place_beside_the_package(package, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setattr("numba.config.CACHE_DIR", "")
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA", "HOME", "USERPROFILE"):
        monkeypatch.setenv(name, str(tmp_path / "file" / "below"))
    folder = compiling.cache_folder(package)
    assert folder is not None and folder.parent == package / "__pycache__" / "linkpose"


@pytest.mark.parametrize(
    ("platform", "variables", "place"),
    [
        ("linux", {}, "home/.cache"),
        ("linux", {"XDG_CACHE_HOME": "asked"}, "asked"),
        ("darwin", {"XDG_CACHE_HOME": "asked"}, "home/Library/Caches"),
        ("win32", {"LOCALAPPDATA": "asked"}, "asked"),
    ],
)
def test_the_code_is_kept_in_the_users_cache(platform, variables, place, package, tmp_path, monkeypatch):
    monkeypatch.setattr("numba.config.CACHE_DIR", "")
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    for name, value in variables.items():
        monkeypatch.setenv(name, str(tmp_path / value))
    folder = compiling.cache_folder(package)
    assert folder is not None and folder.parent == tmp_path / place / "linkpose"


@pytest.mark.parametrize(("damage", "ending"), [("cut", ".nbi"), ("flip", ".nbc")])
def test_a_damaged_file_is_compiled_and_stored_again(ending, damage, package, tmp_path):
    host, place = package.parent, {"NUMBA_CACHE_DIR": tmp_path / "cache"}
    run(TEXT, host, **place)
    for path in (tmp_path / "cache").rglob(f"*{ending}"):
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 4
        path.write_bytes(content if damage == "flip" else content[: len(content) // 3])
    assert run(TEXT, host, **place) == "1.25 0"
    assert run(TEXT, host, **place) == "1.25 1"


def test_code_of_other_arguments_is_not_taken(tmp_path):
    """As processes leave it that keep code of one function at once: each names its file by what it has found."""
    (tmp_path / "sums.py").write_text(
        "from linkpose.compiling import compiled\n@compiled\ndef total(a, b):\n    return a[0] * b[0] + a[1] * b[1]\n"
    )
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\nfrom sums import total\n"
        "print(total((1.5, 2.0), (2.0, 2.0)), total((1, 2), (2, 2)), total.stats.cache_hits)"
    )
    assert run(code, HOST, NUMBA_CACHE_DIR=tmp_path).startswith("7.0 6 Counter()")
    floats, integers = sorted(tmp_path.rglob("*.nbc"))
    kept = floats.read_bytes()
    floats.write_bytes(integers.read_bytes())
    integers.write_bytes(kept)
    for hits in (0, 2):
        output = run(code, HOST, NUMBA_CACHE_DIR=tmp_path)
        assert output.startswith("7.0 6 Counter(") and output.count(": 1") == hits


def test_a_full_disk_costs_no_more_than_the_compiling(tmp_path):
    full = (
        "import builtins, errno\n"
        "real = open\n"
        "def fake(path, mode='r', *more, **others):\n"
        "    if '.nb' in str(path) and 'w' in mode:\n"
        "        raise OSError(errno.ENOSPC, 'No space left on device')\n"
        "    return real(path, mode, *more, **others)\n"
        "builtins.open = fake\n"
    )
    assert run(full + TEXT, HOST, NUMBA_CACHE_DIR=tmp_path) == "1.25 0"


def test_other_users_of_the_compiler_keep_their_place():
    code = "import numba, linkpose.localization.linalg, linkpose.filters.baro\nprint(repr(numba.config.CACHE_DIR))"
    assert run(code, HOST, NUMBA_CACHE_DIR="") == "''"


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="POSIX file modes")
def test_code_that_others_can_write_is_neither_loaded_nor_overwritten(package, tmp_path):
    host, place = package.parent, {"NUMBA_CACHE_DIR": tmp_path / "cache"}
    run(TEXT, host, **place)
    files = list((tmp_path / "cache").rglob("*.nb?"))
    for path in files:
        path.chmod(0o666)
    assert run(TEXT, host, **place) == "1.25 0"
    assert run(TEXT, host, **place) == "1.25 1"
    folder = next((tmp_path / "cache" / "linkpose").iterdir())
    folder.chmod(0o777)
    elsewhere = {**place, "XDG_CACHE_HOME": tmp_path / "mine"}
    assert run(TEXT, host, **elsewhere) == "1.25 0"
    assert list((tmp_path / "mine").rglob("*.nbc"))


PATIENCE_CPU_S = 600.0  # of processor time; scan-match, which takes longest, takes 20 s


@pytest.fixture
def hang_found_by_processor_time():
    """The time of a clock also counts what other processes take, and for how long a hypervisor stops this one."""
    if not hasattr(signal, "setitimer"):
        yield
        return

    def fail(*_):
        pytest.fail(f"it has computed for {PATIENCE_CPU_S:.0f} s")

    before = signal.signal(signal.SIGPROF, fail)
    signal.setitimer(signal.ITIMER_PROF, PATIENCE_CPU_S)
    yield
    signal.setitimer(signal.ITIMER_PROF, 0.0)
    signal.signal(signal.SIGPROF, before)


@pytest.mark.timeout(0)
@pytest.mark.usefixtures("hang_found_by_processor_time")
@pytest.mark.parametrize(
    "name", [*filters.NAMES, *get_args(Method), precompile.TEXT, precompile.NOISES, precompile.FILES]
)
def test_all_that_the_wheel_contains_compiles(name):
    precompile.compile_here(name)
    assert compiling.is_compiled(name)


PREPARE = """
from linkpose.precompile import prepare
lines = []
prepare(["tilt", "baro"], lines.append)
print(lines)
"""


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="process groups of POSIX")
def test_ctrl_c_leaves_what_compiles_to_the_run_that_started_it(tmp_path):
    code = (
        "from linkpose import compiling\n"
        "from linkpose.precompile import Precompilation\n"
        "with Precompilation([]) as compilation:\n"
        "    try:\n"
        "        compilation.wait(lambda line: print(line, flush=True))\n"
        "    except KeyboardInterrupt:\n"
        "        compilation.wait(print)\n"
        "print(compiling.is_compiled('text'))\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(HOST), "NUMBA_CACHE_DIR": str(tmp_path)}
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
        start_new_session=True,
    ) as run_of_filters:  # fmt: skip
        assert run_of_filters.stdout.readline().startswith("Compiling filters")
        os.killpg(run_of_filters.pid, signal.SIGINT)
        output, errors = run_of_filters.communicate()
    assert (output.splitlines()[-1], errors) == ("True", "")


INTERRUPTED = """
import os, signal
import numpy as np
from numba.core.registry import cpu_target
from linkpose.recording import fixedpoint
engine, sent = cpu_target.target_context.codegen()._engine._ee, []
def interrupt(module, *code):
    if ("_format" in module.name) == IS_OURS and not sent:
        sent.append(module)
        os.kill(os.getpid(), signal.SIGINT)
    return before(module, *code)
before, engine.HOOK = engine.HOOK, interrupt
try:
    fixedpoint.format_rows(np.array([[1.25]]), np.array([2]))
except KeyboardInterrupt:
    print("interrupted")
"""


@pytest.mark.parametrize(
    ("state", "hook", "is_ours"), [("cold", "notify", True), ("cold", "notify", False), ("warm", "getbuffer", True)]
)
def test_ctrl_c_while_llvm_calls_back_stops_the_compiler_and_loses_nothing(tmp_path, state, hook, is_ours):
    """ctypes dropped it: "no compiled object yet" followed, and a crash where stored code was loaded."""
    place = {"NUMBA_CACHE_DIR": tmp_path / "cache"}
    if state == "warm":
        run(TEXT, HOST, **place)
    code = INTERRUPTED.replace("HOOK", f"_object_cache_{hook}").replace("IS_OURS", str(is_ours))
    assert run(code + TEXT, HOST, **place) == f"interrupted\n1.25 {int(state == 'warm')}"
    assert run(TEXT, HOST, **place) == "1.25 1"


def test_progress_is_shown_on_a_real_cache_miss_only(tmp_path):
    place = {"NUMBA_CACHE_DIR": tmp_path / "cache", "NUMBA_DISABLE_JIT": 1}
    first = eval(run(PREPARE, HOST, **place))
    assert first and first[0] == "Compiling filters (first run only) 1/2 tilt"
    assert len(first) == len(set(first))
    assert run(PREPARE, HOST, **place) == "[]"
    (tmp_path / "file").touch()
    places = ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME", "LOCALAPPDATA", "USERPROFILE")
    nowhere = dict.fromkeys(places, tmp_path / "file" / "below")
    code = "import linkpose.compiling as c\nc._the_cache = lambda: None\n" + PREPARE
    assert "in each run" in run(code, HOST, NUMBA_DISABLE_JIT=1, **nowhere)


@pytest.mark.parametrize("names", [("mice", "planar-ekf"), ("planar-ekf", "mice")])
def test_filters_that_share_parts_run_in_one_process_in_any_order(names):
    """A part that was local to one module once took the place of another module's part, and the process crashed."""
    code = (
        "from linkpose import filters; from linkpose.experiments.planar import drive; run = drive(1, 8.0); "
        f"print([f'{{filters.create(name, run.rig).process(run.measurements)[-1, 0]:.2f}}' for name in {names}])"
    )
    assert dict(zip(names, eval(run(code, HOST)), strict=True)) == {"mice": "0.45", "planar-ekf": "1.55"}


def test_machine_code_has_no_symbol_for_what_it_contains_of_other_functions(monkeypatch):
    for place in ("_the_cache", "_the_installed"):
        monkeypatch.setattr(compiling, place, lambda: None)
    too_long_to_be_copied = "    x = math.sin(x) if x > 0.5 else math.exp(x) / math.sqrt(x * x + 1.0)\n" * 40
    functions: dict[str, Any] = {"math": math, "__name__": __name__}
    exec(f"def part(x):\n{too_long_to_be_copied}    return x\n", functions)
    part = compiling.inner(functions["part"])

    @compiling.compiled
    def whole(x: float) -> float:
        return part(x) + part(2.0 * x) + part(3.0 * x)

    assert math.isfinite(whole(0.5))
    (code,) = whole.inspect_llvm().values()
    defined = [line for line in code.splitlines() if line.startswith("define ")]
    assert any("4part" in line for line in defined)
    assert all(line.startswith("define private ") == ("4part" in line) for line in defined)
