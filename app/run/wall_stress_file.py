"""Wall shear stress of a run as a surface that ParaView opens."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from taichi_sph.system import replaced

if TYPE_CHECKING:
    from taichi_sph.boundary.wall_stress import WallShearStress
    from taichi_sph.diagnostics import Diagnostics
    from taichi_sph.simulation import Simulation

BEGINNING = b'<?xml version="1.0"?>\n<VTKFile type="PolyData"'
"""What such a file begins with."""
ARRAYS = {
    "WSS": "time average of the wall shear stress [Pa]",
    "TAWSS": "time average of its size [Pa]",
    "OSI": "oscillation index [-]",
    "ArtificialWSS": "part of WSS that artificial viscosity adds to it [Pa]",
}
"""Arrays at the points, by name."""


class WallStressFile:
    """Observer that writes the wall shear stress when a run ends: VTK PolyData.

    Averages are over all steps, from the start or from where the first run of a chain of
    checkpoints began to watch.
    """

    def __init__(self, simulation: "Simulation", path: Path):
        """Watch from now on, or go on."""
        self.measured = simulation.measure_wall_stress()
        vessel = simulation.vessel
        self.faces = np.searchsorted(vessel.wall_vertices, vessel.wall_faces)
        self.path = path

    def on_frame(self, simulation: "Simulation", frame: int, figures: "Diagnostics") -> None:
        """Close the average over a frame."""
        self.measured.look()

    def close(self, ending: str) -> None:
        """Write the file.

        Raises:
            OSError: it cannot be written.
        """
        self.measured.look()
        with replaced(self.path) as file:
            file.write(polydata(self.measured.result(), self.faces).encode())


def polydata(stress: "WallShearStress", faces: np.ndarray) -> str:
    """Wall shear stress as text of a .vtp file; `faces` (m, 3) are of its vertices."""
    values = (stress.mean, stress.tawss, stress.osi, stress.artificial)
    points = "\n".join(_array(values[k], f'Name="{name}"') for k, name in enumerate(ARRAYS))
    comments = "\n".join(f"<!-- {name}: {meaning} -->" for name, meaning in ARRAYS.items())
    count, amount = len(stress.vertices), len(faces)
    return f"""{BEGINNING.decode()} version="1.0" byte_order="LittleEndian">
<!-- wall shear stress over {stress.time:.9g} s; lengths in metres -->
{comments}
<PolyData>
<FieldData>
{_array(np.array([stress.time]), 'Name="WatchedTime" NumberOfTuples="1"')}
</FieldData>
<Piece NumberOfPoints="{count}" NumberOfPolys="{amount}" NumberOfVerts="0" NumberOfLines="0"
 NumberOfStrips="0">
<PointData Vectors="WSS" Scalars="TAWSS" Normals="Normals">
{points}
{_array(stress.normals, 'Name="Normals"')}
</PointData>
<Points>
{_array(stress.vertices, 'Name="Points"')}
</Points>
<Polys>
{_array(faces.ravel(), 'Name="connectivity"')}
{_array(3 * np.arange(1, amount + 1), 'Name="offsets"')}
</Polys>
</Piece>
</PolyData>
</VTKFile>
"""


def _array(values: np.ndarray, attributes: str) -> str:
    kind = "Int64" if values.dtype.kind == "i" else "Float64"
    parts = values.shape[1] if values.ndim > 1 else 1
    number = str if kind == "Int64" else "{:.9g}".format
    rows = values.reshape(len(values), -1)
    text = "\n".join(" ".join(number(v) for v in row) for row in rows)
    return (
        f'<DataArray type="{kind}" {attributes} NumberOfComponents="{parts}" format="ascii">\n'
        f"{text}\n</DataArray>"
    )
