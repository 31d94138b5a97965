"""Named materials: density and composition.

Tissues, air and borosilicate glass: ICRU Report 44 compositions as tabulated by NIST (Hubbell and Seltzer,
NISTIR 5632, table 2). Alloys: nominal compositions of their grade. Polymers, ceramics and sensors: chemical
formula and nominal density.
"""

from __future__ import annotations

from collections.abc import Mapping

__all__ = ["ALIASES", "NAMED"]

# name -> (density in g/cm3, chemical formula or mass fractions)
NAMED: Mapping[str, tuple[float, str | Mapping[str, float]]] = {
    "water": (1.0, "H2O"),
    "air": (1.205e-3, {"C": 0.000124, "N": 0.755268, "O": 0.231781, "Ar": 0.012827}),
    # tissues
    "adipose": (0.95, {"H": 0.114, "C": 0.598, "N": 0.007, "O": 0.278, "Na": 0.001, "S": 0.001, "Cl": 0.001}),
    "blood": (
        1.06,
        {
            "H": 0.102,
            "C": 0.110,
            "N": 0.033,
            "O": 0.745,
            "Na": 0.001,
            "P": 0.001,
            "S": 0.002,
            "Cl": 0.003,
            "K": 0.002,
        }
        | {"Fe": 0.001},
    ),
    "bone": (
        1.92,
        {
            "H": 0.034,
            "C": 0.155,
            "N": 0.042,
            "O": 0.435,
            "Na": 0.001,
            "Mg": 0.002,
            "P": 0.103,
            "S": 0.003,
            "Ca": 0.225,
        },
    ),
    "brain": (
        1.04,
        {
            "H": 0.107,
            "C": 0.145,
            "N": 0.022,
            "O": 0.712,
            "Na": 0.002,
            "P": 0.004,
            "S": 0.002,
            "Cl": 0.003,
            "K": 0.003,
        },
    ),
    "breast": (
        1.02,
        {"H": 0.106, "C": 0.332, "N": 0.030, "O": 0.527, "Na": 0.001, "P": 0.001, "S": 0.002, "Cl": 0.001},
    ),
    "lung": (
        1.05,
        {
            "H": 0.103,
            "C": 0.105,
            "N": 0.031,
            "O": 0.749,
            "Na": 0.002,
            "P": 0.002,
            "S": 0.003,
            "Cl": 0.003,
            "K": 0.002,
        },
    ),
    "muscle": (
        1.05,
        {
            "H": 0.102,
            "C": 0.143,
            "N": 0.034,
            "O": 0.710,
            "Na": 0.001,
            "P": 0.002,
            "S": 0.003,
            "Cl": 0.001,
            "K": 0.004,
        },
    ),
    "soft tissue": (
        1.06,
        {
            "H": 0.102,
            "C": 0.143,
            "N": 0.034,
            "O": 0.708,
            "Na": 0.002,
            "P": 0.003,
            "S": 0.003,
            "Cl": 0.002,
            "K": 0.003,
        },
    ),
    "hydroxyapatite": (3.16, "Ca10P6O26H2"),
    # polymers and glass
    "pmma": (1.19, "C5H8O2"),
    "polyethylene": (0.93, "C2H4"),
    "polypropylene": (0.90, "C3H6"),
    "polystyrene": (1.06, "C8H8"),
    "polycarbonate": (1.20, "C16H14O3"),
    "peek": (1.32, "C19H12O3"),
    "ptfe": (2.20, "C2F4"),
    "borosilicate glass": (
        2.23,
        {"B": 0.040064, "O": 0.539562, "Na": 0.028191, "Al": 0.011644, "Si": 0.377220, "K": 0.003321},
    ),
    # alloys
    "stainless steel": (8.0, {"Fe": 0.700, "Cr": 0.190, "Ni": 0.095, "Mn": 0.015}),  # AISI 304
    "stainless steel 316l": (
        7.95,
        {"Fe": 0.655, "Cr": 0.170, "Ni": 0.120, "Mo": 0.025, "Mn": 0.020, "Si": 0.010},
    ),
    "ti6al4v": (4.43, {"Ti": 0.90, "Al": 0.06, "V": 0.04}),
    "cobalt chrome": (8.3, {"Co": 0.66, "Cr": 0.28, "Mo": 0.06}),  # ASTM F75
    "brass": (8.47, {"Cu": 0.63, "Zn": 0.37}),
    "bronze": (8.8, {"Cu": 0.88, "Sn": 0.12}),
    # ceramics
    "zirconia": (6.05, "ZrO2"),
    "alumina": (3.97, "Al2O3"),
    "silica": (2.20, "SiO2"),
    "calcium carbonate": (2.71, "CaCO3"),
    "barium sulfate": (4.50, "BaSO4"),
    # sensors and scintillators
    "caesium iodide": (4.51, "CsI"),
    "sodium iodide": (3.67, "NaI"),
    "gadolinium oxysulfide": (7.34, "Gd2O2S"),
    "cadmium telluride": (5.85, "CdTe"),
    "gallium arsenide": (5.32, "GaAs"),
    "cadmium tungstate": (7.90, "CdWO4"),
    "lutetium aluminium garnet": (6.73, "Lu3Al5O12"),
    "yttrium aluminium garnet": (4.55, "Y3Al5O12"),
}

ALIASES: Mapping[str, str] = {
    "aluminium": "aluminum",  # elements carry their American names in xraydb
    "caesium": "cesium",
    "sulphur": "sulfur",
    "cortical bone": "bone",
    "adipose tissue": "adipose",
    "fat": "adipose",
    "acrylic": "pmma",
    "plexiglass": "pmma",
    "teflon": "ptfe",
    "pyrex": "borosilicate glass",
    "steel": "stainless steel",
    "ss304": "stainless steel",
    "ss316l": "stainless steel 316l",
    "cocr": "cobalt chrome",
    "gos": "gadolinium oxysulfide",
    "gadox": "gadolinium oxysulfide",
    "luag": "lutetium aluminium garnet",
    "yag": "yttrium aluminium garnet",
    "cesium iodide": "caesium iodide",
    "barium sulphate": "barium sulfate",
}
