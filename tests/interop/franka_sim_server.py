"""franka-sim at an address, with the FCI's motion limits enforced. Runs in `.venv-interop`.

python franka_sim_server.py ADDRESS
"""

import os
import shutil
import sys
import tempfile
from pathlib import Path

import franky_sim
from franka_sim.franka_sim_server import FrankaSimServer

with tempfile.TemporaryDirectory() as folder:
    # It would load its arm from the internet. franky-sim has the same one, whose file asks for its
    # meshes under another name.
    model = Path(folder) / "model"
    shutil.copytree(Path(franky_sim.__file__).parent / "assets", model)
    (model / "meshes").rename(model / "assets")
    os.environ["FR3_MJCF"] = str(model / "fr3.xml")
    FrankaSimServer(host=sys.argv[1], enforce_motion_limits=True).start()
