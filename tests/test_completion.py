"""A shell completes commands and options."""

import shutil
import subprocess
import sys

import pytest

from tomo_polysplat.cli.main import COMMANDS, main

pytest.importorskip("shtab")

ASK = """
source {script}
COMP_WORDS=({words})
COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))
_shtab_tomo_polysplat
printf '%s\\n' "${{COMPREPLY[@]}}"
"""


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes_commands_options_and_files(tmp_path, capsys):
    assert main(["completion", "bash"]) == 0
    script = tmp_path / "completion.sh"
    script.write_text(capsys.readouterr().out)
    (tmp_path / "scan.h5").touch()

    def completed(words):
        text = ASK.format(script=script, words=words)
        done = subprocess.run(["bash", "-c", text], cwd=tmp_path, capture_output=True, text=True, check=True)
        return set(done.stdout.split())

    assert completed("tomo-polysplat ''") >= {module.NAME for module in COMMANDS}
    assert completed("tomo-polysplat rec") == {"recon"}
    assert {"--output", "--overwrite"} <= completed("tomo-polysplat recon --o")
    assert completed("tomo-polysplat recon --quality ''") >= {"fast", "balanced", "best"}
    assert "scan.h5" in completed("tomo-polysplat recon sca")


def test_other_shells_and_a_missing_library(capsys, monkeypatch):
    assert main(["completion", "zsh"]) == 0 and capsys.readouterr().out.startswith("#compdef tomo-polysplat")
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert main(["completion", "bash"]) == 2
    assert "tomo-polysplat[completion]" in capsys.readouterr().err
