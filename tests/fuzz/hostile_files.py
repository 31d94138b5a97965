"""Scans and results in files that somebody has tampered with."""

import io
import warnings
import zipfile
from contextlib import suppress

import h5py
import numpy as np
from hostile_values import ARRAYS, OBJECTS, TEXTS, damaged, mostly, replaced
from hypothesis import strategies as st

ROWS, VIEWS, COLUMNS, SHAPE = 2, 3, 4, (2, 3, 5)
WINDOW = np.array([-1.0, 1, -1, 1, -0.5, 0.5])
# What h5py says to values that HDF5 has no place for.
IMPOSSIBLE = (TypeError, ValueError, OSError, RuntimeError, KeyError, AttributeError)
HUGE = [(10**12,), (10**6, 10**6, 10**6), (2**62, 4), (3, 10**11, 4), (-5, 2), (2**200,)]


def vectors():
    angles = np.arange(VIEWS) * 2.0
    zero = np.zeros(VIEWS)
    source = 10 * np.stack([np.sin(angles), -np.cos(angles), zero])
    across = 0.3 * np.stack([np.cos(angles), np.sin(angles), zero])
    return np.concatenate([source, -source, across, 0.3 * np.stack([zero, zero, zero + 1])]).T


def projections():
    return np.linspace(0, 2, VIEWS * ROWS * COLUMNS, dtype=np.float32).reshape(VIEWS, ROWS, COLUMNS)


ARCHIVE = {
    "projections": projections(),
    "vectors": vectors(),
    "vol_shape": np.array(SHAPE),
    "vol_window": WINDOW,
    "unit": np.array("mm"),
    "astra_type": np.array("cone_vec"),
    "energies": np.array([30.0, 60.0]),
    "spectrum": np.array([1.0, 2.0]),
    "spectrum_label": np.array("two lines"),
    "truth_mu": np.ones(SHAPE, np.float32),
    "metal_mask": np.zeros(SHAPE, bool),
    "valid": np.ones((VIEWS, ROWS, COLUMNS), bool),
    "e_ref": np.array(50.0),
    "water_correction": np.array([0.0, 1.0, 0.1]),
}
ODD = ARRAYS | OBJECTS | TEXTS.map(np.array)
METHODS = [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED]
RARE_METHODS = [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]
HEADERS = [
    "{'descr': '<f4', 'fortran_order': False, 'shape': %s}",
    "{'descr': '|V0', 'fortran_order': False, 'shape': %s}",
    "{'descr': '|O', 'fortran_order': False, 'shape': %s}",
    "{'descr': '<U100000000', 'fortran_order': False, 'shape': %s}",
    "{'descr': [('a', '<f4', %s)], 'fortran_order': False, 'shape': ()}",
    "(" * 5000 + "%s",
    "__import__('os').system('exit 3') or %s",
]


def npy(array, header=None) -> bytes:
    """An array in NumPy's format, under a header of one's own if given."""
    buffer = io.BytesIO()
    if header is None:
        np.lib.format.write_array(buffer, np.asarray(array))
        return buffer.getvalue()
    text = header.encode()[:60000] + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + np.asarray(array).tobytes()


def npy_archive(arrays, compression=zipfile.ZIP_STORED) -> bytes:
    """Such arrays in a NumPy archive, pickles among them."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, array in arrays.items():
            archive.writestr(f"{name}.npy", npy(array), compression)
    return buffer.getvalue()


@st.composite
def npz_files(draw, whole) -> bytes:
    """An archive with other arrays, lying headers, bombs, and damaged bytes."""
    arrays = draw(replaced(whole, ODD))
    lying = draw(mostly(st.just(set()), st.sets(st.sampled_from(sorted(whole)), min_size=1, max_size=2)))
    methods = mostly(st.sampled_from(METHODS), st.sampled_from(RARE_METHODS))
    method, buffer = draw(methods), io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(buffer, "w") as archive:
        warnings.simplefilter("ignore")
        for name, array in arrays.items():
            content = npy(array)
            if name in lying:
                # A bomb of a few kilobytes that unpacks into megabytes, or a header without data.
                zeros = np.zeros(draw(st.sampled_from([0, 10, 10**6, 4 * 10**6])), np.uint8)
                shape = draw(st.sampled_from([*HUGE, (len(zeros) // 4,)]))
                content = npy(zeros, draw(st.sampled_from(HEADERS)) % (shape,))
            archive.writestr(f"{name}.npy", content, method)
    return draw(damaged(buffer.getvalue()))


EXCHANGE = {
    "exchange/data": np.full((VIEWS, ROWS, COLUMNS), 900, np.uint16),
    "exchange/data_white": np.full((2, ROWS, COLUMNS), 1000, np.uint16),
    "exchange/data_dark": np.full((2, ROWS, COLUMNS), 10, np.uint16),
    "exchange/theta": np.array([0.0, 60, 120]),
    "measurement/sample/name": "a sample",
    "measurement/instrument/detection_system/objective/resolution": np.array(1.3),
}
OURS = {
    "polysplat/geometry/vectors": vectors(),
    "polysplat/geometry/volume_shape": np.array(SHAPE),
    "polysplat/geometry/volume_window": WINDOW,
    "polysplat/spectrum/energies": np.array([30.0, 60.0]),
    "polysplat/spectrum/weights": np.array([1.0, 2.0]),
    "polysplat/truth": np.ones(SHAPE, np.float32),
    "polysplat/metal_mask": np.zeros(SHAPE, bool),
    "polysplat/valid": np.ones((VIEWS, ROWS, COLUMNS), bool),
    "polysplat/water_correction": np.array([0.0, 1.0, 0.1]),
}
RESULT = {
    "polysplat/basis": np.ones((3, *SHAPE), np.float32),
    "polysplat/gaussians/position": np.zeros((4, 3), np.float32),
    "polysplat/gaussians/scale": np.ones((4, 3), np.float32),
    "polysplat/gaussians/rotation": np.ones((4, 4), np.float32),
    "polysplat/gaussians/density": np.ones(4, np.float32),
    "polysplat/gaussians/u": np.zeros(4, np.float32),
    "polysplat/materials": '["water", "aluminium", "iron"]',
    "polysplat/history": '[{"seconds": 1.0, "loss": 2.0, "held_out": null, "stage": "fit"}]',
    "polysplat/plan": '{"stop": {"value": "passes", "why": "made", "status": "found", "evidence": {}}}',
    "polysplat/counts": '{"rays": 5}',
    "polysplat/settings": "{}",
}
ATTRIBUTES = {
    ("polysplat/geometry", "astra_type"): "cone_vec",
    ("polysplat/geometry", "unit"): "mm",
    ("exchange/data", "input"): "counts",
    ("exchange/theta", "units"): "degrees",
    ("polysplat/truth", "energy_kev"): 50.0,
    ("polysplat/spectrum", "label"): "lines",
}
RESULT_ATTRIBUTES = {
    ("polysplat", name): value
    for name, value in {
        "format": 1,
        "unit": "cm",
        "seconds": 2.0,
        "flipped_2d": False,
        "energy_kev": 50.0,
        "lower": np.array([-1.0, -1, -1]),
        "upper": np.array([1.0, 1, 1]),
    }.items()
}
JSON = st.sampled_from(
    [
        "",
        "[",
        "[" * 90_000,
        "{}",
        "[]",
        "[1]",
        "[[]]",
        "1e999",
        '{"a": {"b": [1]}}',
        '["x"]',
        '["iron", "iron", "iron"]',
        '[{"seconds": "soon", "loss": {}}]',
        "null",
        '{"<b>": "<script>"}',
    ]
)


def _huge(file, path):
    shape = (10**12,)
    file.create_dataset(path, shape, "f4", chunks=(1000,), compression="gzip")


def _huge_chunk(file, path):
    file.create_dataset(path, (3, 4), "f4", chunks=(3, 4), maxshape=(None, None))
    del file[path]
    file.create_dataset(path, (10,), "f4", chunks=(5 * 10**8,), maxshape=(None,))


def _bomb(file, path):
    file.create_dataset(path, data=np.zeros((4, 500, 500), np.float32), compression="gzip")


def _virtual(file, path):
    layout = h5py.VirtualLayout((VIEWS, ROWS, COLUMNS), "f4")
    layout[:] = h5py.VirtualSource("/dev/zero", "data", (VIEWS, ROWS, COLUMNS))
    file.create_virtual_dataset(path, layout)


def _outside(file, path):
    file.create_dataset(path, (VIEWS, ROWS, COLUMNS), "f4", external=[("/dev/zero", 0, h5py.h5f.UNLIMITED)])


def _long_text(file, path):
    file.create_dataset(path, (), "S1000000000")


TRICKS = {
    "soft": lambda file, path: file.__setitem__(path, h5py.SoftLink("/elsewhere")),
    "circle": lambda file, path: file.__setitem__(path, h5py.SoftLink(f"/{path}")),
    "circle of groups": lambda file, path: file.__setitem__(path, file["/"]),
    "external": lambda file, path: file.__setitem__(path, h5py.ExternalLink("/dev/zero", "/data")),
    "group": lambda file, path: file.create_group(path),
    "type": lambda file, path: file.__setitem__(path, np.dtype("f4")),
    "empty": lambda file, path: file.__setitem__(path, h5py.Empty("f4")),
    "reference": lambda file, path: file.create_dataset(path, data=file.ref, dtype=h5py.ref_dtype),
    "ragged": lambda file, path: file.create_dataset(path, (3,), h5py.vlen_dtype(np.dtype("f4"))),
    "opaque": lambda file, path: file.create_dataset(path, data=np.zeros(3, "V7")),
    "huge": _huge, "huge chunk": _huge_chunk, "bomb": _bomb, "virtual": _virtual, "outside": _outside,
    "long text": _long_text,
}  # fmt: skip


def _put(file, path, value):
    """A dataset, of whatever HDF5 can hold of a value; the rest is left out."""
    with suppress(*IMPOSSIBLE):
        file[path] = value


def _describe(file, path, name, value):
    with suppress(*IMPOSSIBLE):
        file[path].attrs[name] = value


def image(datasets, attributes, tricks) -> bytes:
    """The bytes of an HDF5 file."""
    with h5py.File("scan.h5", "w", driver="core", backing_store=False) as file:
        for path, value in datasets.items():
            if not any(f"{path}/".startswith(f"{trick}/") for trick in tricks):
                _put(file, path, value)
        for path, trick in tricks.items():
            with suppress(*IMPOSSIBLE):
                TRICKS[trick](file, path)
        for (path, name), value in attributes.items():
            _describe(file, path, name, value)
        file.flush()
        return file.id.get_file_image()


@st.composite
def hdf5_files(draw, datasets, attributes, values) -> bytes:
    """A file with other datasets and attributes, tricks, and damaged bytes."""
    content = draw(replaced(datasets, values))
    paths = sorted(
        {*datasets, "exchange", "polysplat", "polysplat/spectrum", "polysplat/geometry", "measurement"}
    )
    tricks = draw(
        st.just({}) | st.dictionaries(st.sampled_from(paths), st.sampled_from(sorted(TRICKS)), max_size=2)
    )
    about = draw(replaced(attributes, ODD | TEXTS | st.floats()))
    return draw(damaged(image(content, about, tricks)))


HDF5_SCANS = hdf5_files(EXCHANGE, ATTRIBUTES, ODD) | hdf5_files(EXCHANGE | OURS, ATTRIBUTES, ODD)
HDF5_RESULTS = hdf5_files(RESULT, RESULT_ATTRIBUTES, ODD | JSON)
