"""What docs/porting.md says works as it stands there."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from contract_checks import check_angles, check_offset, check_reads
from contract_modbus import ModbusCase
from patience import PATIENCE
from ports import own_host

from gapbridge.core.errors import InputError
from gapbridge.drivers.modbus import encode
from gapbridge.drivers.modbus.profile import read_profile

PORTING = (Path(__file__).parents[3] / "docs" / "porting.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```yaml\n(.*?)```", PORTING, re.DOTALL)


@pytest.fixture
def profile(tmp_path: Path) -> Path:
    [text] = [block for block in BLOCKS if block.startswith("name: My arm")]
    path = tmp_path / "my_arm.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_map_of_the_page_reads_writes_and_is_reported_when_wrong(profile: Path) -> None:
    with ModbusCase(str(profile)) as case:
        with case.driver() as driver:
            check_reads(driver, case.model)
            check_angles(case, driver)
        with case.driver() as driver:
            check_offset(case, driver)
    profile.write_text(profile.read_text().replace("scale: 0.01", "scale: 0"))
    with pytest.raises(InputError, match=r"my_arm\.yaml, line 8: state\.velocity\.scale: found 0"):
        read_profile(profile)


def test_the_robots_program_of_the_page_uses_only_the_words_that_it_checked() -> None:
    """A register that is read again may belong to the next offset by then."""
    [program] = re.findall(r"```\n(def gapbridge_mailbox.*?)```", PORTING, re.DOTALL)
    assert re.findall(r"read_port_register\((.*?)\)", program) == ["234 + i", "244"]
    assert "words[i] = read_port_register(234 + i)\n" in program


def test_the_checksum_is_the_one_on_the_page() -> None:
    words = [7, 100, 65436, 3, 4, 65531, 6, 9, 2500, 1000]
    formula = re.search(r"\((\d+) \+ 1 w0 \+ 2 w1 .*modulo (\d+)", PORTING)
    assert formula is not None
    seed, modulus = map(int, formula.groups())
    total = seed + sum((i + 1) * word for i, word in enumerate(words))
    assert encode.checksum(words) == total % modulus
    assert encode.mailbox_words(7, [100, -100, 3, 4, -5, 6], 9, [2500, 1000]) == [
        *words,
        total % modulus,
    ]
    assert encode.rate_counts((0.05, 0.1)) == [2500, 1000]


def test_rates_are_rounded_down_and_never_to_nothing() -> None:
    assert encode.rate_counts((0.00005, 0.00199)) == [2, 19]
    with pytest.raises(ValueError, match="offset_rate: found 1e-05"):
        encode.rate_counts((1e-5, 0.1))


@pytest.mark.slow
def test_a_cell_with_a_map_of_the_users_is_served_and_run(profile: Path) -> None:
    cell = profile.parent / "cell.yaml"
    cell.write_text(
        "robot: {model: ur5e}\npayload: {mass: 2.0}\ncompliance: {axial: [2.0e-6, 4.0e-6, 4.0e-6, "
        "8.0e-6, 8.0e-6, 8.0e-6]}\nrecording: {folder: null}\n"
        f"link: {{driver: modbus, profile: my_arm.yaml, host: {own_host()}, port: 15822}}\n"
    )
    command = [sys.executable, "-m", "gapbridge"]
    served = subprocess.Popen([*command, "simulate", str(cell)], stdout=subprocess.PIPE, text=True)
    try:
        assert served.stdout is not None
        assert "Modbus 15822" in served.stdout.readline()
        assert served.stdout.readline().startswith("ready")
        run = subprocess.run(
            [*command, "run", str(cell), "--arm", "--duration", "3"],
            capture_output=True, text=True, check=False, timeout=120,
        )  # fmt: skip
        assert run.returncode == 0, run.stdout + run.stderr
        assert "armed -> compensating" in run.stdout
        assert re.search(r"setpoints written [1-9]\d", run.stdout), run.stdout
    finally:
        served.terminate()
        served.wait(PATIENCE)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("link", "words"),
    [
        (
            "{driver: telepathy}",
            r"cell\.yaml, line 2: link\.driver: found 'telepathy', expected one",
        ),
        ("{driver: modbus}", r"line 2: link\.profile: found nothing, expected a shipped profile"),
        (
            "{driver: modbus, profile: ur, prot: 5}",
            r"link\.prot: found an unknown key 'prot'.*port",
        ),
        ("{driver: modbus, profile: ur, transport: rtu}", r"expected serial, the port to open"),
        ("{driver: modbus, profile: nobody}", r"link\.profile: found 'nobody', expected one of d"),
        ("{driver: modbus, profile: no.yaml}", r"no\.yaml: file not found"),
        ("{driver: modbus, profile: xarm}", r"xarm\.yaml, line \d+: joints: found 7, expected 6"),
    ],
)
def test_a_link_that_cannot_be_is_one_line(tmp_path: Path, link: str, words: str) -> None:
    cell = tmp_path / "cell.yaml"
    cell.write_text(f"robot: {{model: ur5e}}\nlink: {link}\n")
    for command in (["run", "--observe", "--duration", "1"], ["simulate"]):
        found = subprocess.run(
            [sys.executable, "-m", "gapbridge", command[0], str(cell), *command[1:]],
            capture_output=True, text=True, check=False, timeout=PATIENCE,
        )  # fmt: skip
        assert found.returncode == 2, (command, found.stdout, found.stderr)
        assert len(found.stderr.strip().splitlines()) == 1, found.stderr
        assert re.search(words, found.stderr), found.stderr
