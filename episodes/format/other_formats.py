"""Recordings in formats that are not read here: known by suffix and first bytes, told by name."""

from pathlib import Path

from touchgoal.runtime.errors import UserError

_FORMATS = (  # suffixes, first bytes, name
    ((".hdf5", ".h5"), b"\x89HDF\r\n", "HDF5, as robomimic, LIBERO and ALOHA write it"),
    ((".mcap",), b"\x89MCAP0", "an MCAP log"),
    ((".bag",), b"#ROSBAG", "a ROS bag"),
    ((".db3",), b"SQLite format 3", "a ROS 2 bag"),
    ((".npz",), b"PK\x03\x04", "a NumPy archive"),
    ((".npy",), b"\x93NUMPY", "a NumPy array"),
    ((".pkl", ".pickle"), b"\x80\x04\x95", "a Python pickle"),
)


def refuse_other_format(path: Path) -> None:
    """Raise UserError if a file is a recording in one of the formats: its name and the way in."""
    if not path.is_file():
        return
    with path.open("rb") as file:
        begin = file.read(16)
    for suffixes, signature, name in _FORMATS:
        if path.suffix.lower() in suffixes or begin.startswith(signature):
            raise UserError(
                f"{path} is {name}, which is not read here: convert it to a LeRobotDataset v3 "
                "(docs/data_format.md), or its pictures to videos or folders of PNG files"
            )
