"""The commands' manners: help, exit codes, one clear line for each error."""

import os
import subprocess
import sys

import pytest
from click.testing import CliRunner

from revisitd.daemon.cli import cli


def invoke(*arguments):
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


def test_small_matrix_products_do_not_keep_a_second_core_busy():
    """Each library's own threads are started when it is loaded."""
    count = "import os, revisitd.daemon.cli, numpy, scipy.linalg; print(len(os.listdir('/proc/self/task')))"
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    found = subprocess.run([sys.executable, "-c", count], env=environment, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "1"


@pytest.mark.parametrize("name", sorted(cli.commands))
def test_every_command_has_help(name):
    command = cli.commands[name]
    assert command.help
    assert all(option.help for option in command.params if option.param_type_name == "option")
    assert invoke(name, "--help").exit_code == 0


def test_the_readme_names_every_command(request):
    readme = (request.config.rootpath / "README.md").read_text()
    assert [name for name in cli.commands if f"revisitd {name}" not in readme] == []


@pytest.mark.parametrize(
    "arguments,code,says",
    [
        (["replay", "none.pcap", "--data", "out"], 66, "there is no file none.pcap"),
        (["replay", "x.pcap", "--data", "out", "--rate", "fast"], 2, "neither 'max' nor a number"),
        (["replay", "x.pcap", "--data", "out", "--config", "none.toml"], 78, "none.toml: cannot be read"),
        (["changes", "--data", "none"], 74, "not a revisitd data directory"),
        (["trajectory", "--data", "none"], 74, "not a revisitd data directory"),
        (["plot", "--data", "none", "-o", "map.png"], 74, "not a revisitd data directory"),
        (["check-config", "none.toml"], 78, "none.toml: cannot be read"),
        (["simulate", "out", "--scenario", "moon"], 2, "'moon'"),
        (["changes"], 2, "Missing option '--data'"),
    ],
)
def test_an_error_is_one_line_and_its_exit_code(arguments, code, says, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = invoke(*arguments)
    assert result.exit_code == code, result.output
    assert says in result.output
    assert "Traceback" not in result.output
    assert not (tmp_path / "out").exists()


def test_printed_settings_pass_the_check(tmp_path):
    path = tmp_path / "revisitd.toml"
    path.write_text(invoke("dump-config").output)
    assert invoke("check-config", path).output == f"{path}: ok\n"


def test_scenarios_are_listed():
    pytest.importorskip("revisitd.drivers.virtual", reason="the virtual sensor needs the extra [sim]")
    names = {line.split()[0] for line in invoke("simulate", "--list").output.splitlines()}
    assert {"demo", "short", "long", "quiet"} <= names
