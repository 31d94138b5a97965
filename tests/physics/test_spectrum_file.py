"""Tables of a spectrum as other programs write them; what cannot be read is told by its line."""

import numpy as np
import pytest

from tomo_polysplat.cli.main import main
from tomo_polysplat.physics.spectrum_file import read_spectrum_table

ENERGIES, WEIGHTS = [20.5, 30.0, 41.25], [0.5, 2e-3, 1.0]
TABLES = {
    "blanks": "20.5 0.5\n30 2e-3\n41.25 1\n",
    "commas and a header": "energy (keV),weight\n20.5,0.5\n30,2e-3\n41.25,1\n",
    "semicolons and decimal commas": "keV;Gewicht\n20,5;0,5\n30;2e-3\n41,25;1,0\n",
    "tabs, quotes and a last empty column": '"20.5"\t"0.5"\t\n"30"\t"2e-3"\t\n"41.25"\t"1"\t\n',
    "remarks": "# tube\n% 90 kV\ntube of 90 kV, 2 mm of Al\n20.5 0.5  # first\n\n30 2e-3\n// end\n41.25 1",
    "line ends of three systems": "20.5 0.5\r\n30 2e-3\r41.25 1\n",
}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32"])
@pytest.mark.parametrize("name", TABLES)
def test_a_table_is_read_in_any_dress(tmp_path, name, encoding):
    path = tmp_path / "table.csv"
    path.write_bytes(TABLES[name].encode(encoding))
    energies, weights = read_spectrum_table(path)
    assert energies.tolist() == ENERGIES and weights.tolist() == WEIGHTS


def test_a_header_in_an_old_code_page_is_no_matter(tmp_path):
    path = tmp_path / "table.txt"
    path.write_bytes("Röhre\n20.5 0.5\n30 1\n".encode("latin-1"))
    assert np.array_equal(read_spectrum_table(path), [[20.5, 30.0], [0.5, 1.0]])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("keV w\n20 1\n30 x\n", r"'30 x' in line 3 of "),
        ("keV w\n30 x\n", r"'30 x' in line 2 of "),
        ("20 1 4\n", r"'20 1 4' in line 1 of "),
        ("20 1\n\n30\n", r"'30' in line 3 of "),
        ("20 1\nend\x1b[2J\n", r"'end\\x1b\[2J' in line 2 of "),
        ("energy\nweight\n", "lines of two numbers, keV and weight, got none in "),
        ("", "a file with contents, got .*empty"),
    ],
)
def test_the_line_that_is_no_pair_is_told(tmp_path, text, says):
    path = tmp_path / "table.txt"
    path.write_text(text)
    with pytest.raises(ValueError, match=says):
        read_spectrum_table(path, "--spectrum")


def test_the_command_line_names_its_option(scan_file, tmp_path, capsys):
    path = tmp_path / "table.txt"
    path.write_text("20 1\n30 one\n")
    output = str(tmp_path / "v.h5")
    assert main(["recon", str(scan_file), "-o", output, "--spectrum", str(path)]) == 2
    assert "--spectrum: expected two numbers a line, got '30 one' in line 2" in capsys.readouterr().err
