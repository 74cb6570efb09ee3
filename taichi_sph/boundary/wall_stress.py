"""Wall shear stress, gathered from the friction of blood on the wall's proxies.

    F_k   = -m_0 sum_i a_ik,  less its part along n_k                        [N]
    tau_v = sum_k W_vk F_k / sum_k W_vk A_k                                  [Pa]

a_ik is the friction of proxy k on particle i (Eq. 16), m_0 = rho_0 d^3 the blood that a particle
stands for and A_k the wall that a proxy stands for; a vertex v of the mesh takes what lies within a
support radius of it, on its own side of a septum.  So the friction on the wall is the force that
blood has felt, turned round: no velocity is differentiated.

F_k is summed at every step and averaged from one look to the next, for a proxy meets few particles
at a time and its friction is noise in an instant.  Of the averages tau over a time T

    TAWSS = 1/T int |tau| dt,    OSI = 1/2 (1 - |int tau dt| / int |tau| dt)

(Ku et al. 1985, doi:10.1161/01.ATV.5.3.293; He and Ku 1996, doi:10.1115/1.2795948).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from taichi_sph.boundary.boundary import BloodFlow, Boundary
from taichi_sph.errors import RunError
from taichi_sph.fluid.calibration import plane_proxy_volume
from taichi_sph.fluid.forces import wall_pair_acceleration
from taichi_sph.fluid.model import AccelerationModel, Fluid
from taichi_sph.geometry.mesh import Floats
from taichi_sph.particles.smoothing_kernel import WendlandC2
from taichi_sph.particles.wall import SAME_WAY, Proxies
from taichi_sph.runtime import finish_fields


@dataclass(frozen=True)
class WallShearStress:
    """Wall shear stress at the vertices of the wall, over the time that was watched."""

    vertices: Floats
    """(n, 3) [m]."""
    normals: Floats
    """Unit normals out of the lumen, (n, 3)."""
    time: float
    """Watched for so long [s]."""
    mean: Floats
    """Time average of the stress that blood puts on the wall [Pa], (n, 3)."""
    tawss: Floats
    """Time average of its size [Pa], (n,)."""
    osi: Floats
    """Oscillation index, 0 of a steady stress to 1/2, (n,); 0 where there is none."""
    artificial: Floats
    """Time average that the artificial viscosity adds to it [Pa], (n, 3)."""


class WallStress(Boundary):
    """Sums of the friction on the wall of a flow; it changes nothing."""

    name = "wall_stress"

    def __init__(self, blood: BloodFlow, fluid: Fluid, vertices: Floats, normals: Floats):
        """Watch from now on.

        Args:
            blood: its wall's friction is summed.
            fluid: constants of the sums.
            vertices: of the wall [m], (n, 3).
            normals: unit normals out of the lumen there, (n, 3).
        """
        self.blood, self.fluid = blood, fluid
        self.vertices, self.normals = vertices, normals
        rows = max(blood.wall.count, 1)
        self.impulse = ti.Vector.field(3, float, rows)
        """int F_k dt since the last look [N s]."""
        self.artificial_impulse = ti.Vector.field(3, float, rows)
        """The same of the artificial viscosity."""
        finish_fields()
        self.reset()

    def reset(self) -> None:
        """Watch from now on."""
        n = len(self.vertices)
        self._since_look = self._time = 0.0
        self._stress, self._artificial = np.zeros((n, 3)), np.zeros((n, 3))
        self._size = np.zeros(n)
        self._read_wall()

    def _read_wall(self) -> None:
        """Put the sums back to zero, for the wall's proxies as they are sorted now."""
        self._given: Proxies = self.blood.wall.given
        self._spread = self._make_spread()
        self.impulse.fill(0.0)
        self.artificial_impulse.fill(0.0)

    def _make_spread(self) -> csr_matrix:
        """W_vk / sum_k W_vk A_k, (vertices, rows of the wall's fields)."""
        wall, kernel = self.blood.wall, self.fluid.kernel
        given = Proxies(*(rows[wall.order] for rows in wall.given))
        feet = given.position - wall.setback * given.normal
        area = proxy_area(given, kernel, wall.setback, wall.spacing)
        pairs = cKDTree(self.vertices).sparse_distance_matrix(
            cKDTree(feet), kernel.support_radius, output_type="coo_matrix"
        )
        same = (self.normals[pairs.row] * given.normal[pairs.col]).sum(axis=1) > SAME_WAY
        v, k, weight = pairs.row[same], pairs.col[same], kernel.w_of(pairs.data[same])
        total = np.bincount(v, weight * area[k], len(self.vertices))
        rows = self.impulse.shape[0]
        return csr_matrix((weight / total[v], (v, k)), (len(self.vertices), rows))

    def before_drift(self, dt: float, model: AccelerationModel) -> float:
        """Add the friction of a step.

        Raises:
            RunError: the model's forces are none between pairs.
        """
        if self.blood.wall.given is not self._given:
            self.look()
            self._read_wall()
        coefficients = model.pair_coefficients
        if coefficients is None:
            raise RunError(
                f"wall shear stress: {model.name} gives accelerations and no friction on the wall; "
                "allowed: a model whose forces are summed over pairs"
            )
        fluid, _, viscosity, sound_speed = coefficients
        blood = self.blood
        add_friction(
            blood.particles, blood.wall, blood.neighbors, fluid, viscosity, sound_speed,
            dt * blood.particles.mass, self.impulse, self.artificial_impulse,
        )  # fmt: skip
        self._since_look += dt
        return 0.0

    def look(self) -> Floats:
        """Stress on the wall [Pa], (n, 3), averaged since the last look; zero without a step."""
        elapsed = self._since_look
        if elapsed == 0.0:
            return np.zeros_like(self._stress)
        stress = self._spread @ self.impulse.to_numpy().astype(float)
        self._stress += stress
        self._size += np.linalg.norm(stress, axis=1)
        self._artificial += self._spread @ self.artificial_impulse.to_numpy().astype(float)
        self._time += elapsed
        self._since_look = 0.0
        self.impulse.fill(0.0)
        self.artificial_impulse.fill(0.0)
        return np.asarray(stress / elapsed)

    def result(self) -> WallShearStress:
        """What has been watched up to the last look."""
        time = max(self._time, np.finfo(float).tiny)
        steady = np.linalg.norm(self._stress, axis=1) / np.maximum(self._size, 1e-300)
        return WallShearStress(
            self.vertices, self.normals, self._time, self._stress / time, self._size / time,
            np.where(self._size > 0.0, 0.5 * (1.0 - np.minimum(steady, 1.0)), 0.0),
            self._artificial / time,
        )  # fmt: skip

    def save_state(self) -> dict[str, Any]:
        """The sums; a state is saved between two looks."""
        self.look()
        return {
            "time": self._time, "stress": self._stress.copy(), "size": self._size.copy(),
            "artificial": self._artificial.copy(),
        }  # fmt: skip

    def load_state(self, saved: dict[str, Any]) -> None:
        """Go on from saved sums."""
        self.reset()
        self._time = float(saved["time"])
        self._stress, self._size = np.array(saved["stress"]), np.array(saved["size"])
        self._artificial = np.array(saved["artificial"])


def proxy_area(given: Proxies, kernel: WendlandC2, setback: float, spacing: float) -> Floats:
    """Area A_k of the lumen's surface that a proxy stands for [m^2], (m,).

    Its volume (Eq. 3) is as much more than a plane layer's as its area is; in a tube the layer lies
    a setback outside the surface.

    Args:
        given: the proxies.
        kernel: of the sums.
        setback: of the proxies behind the lumen's surface [m].
        spacing: of the proxies [m].
    """
    behind = spacing**2 * given.volume / plane_proxy_volume(kernel, spacing)
    return np.asarray(behind / (1.0 + given.curvature * setback / kernel.smoothing_length))


@ti.kernel
def add_friction(
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    viscosity: ti.template(),
    sound_speed: float,
    weight: float,
    physical: ti.template(),
    artificial: ti.template(),
):
    """Add -weight a_ik, less its part along n_k, to each proxy of the wall [N s].

    With the artificial viscosity's share beside it.  Sums of threads: their last digits vary.
    Reads: position, velocity, density, scratch.  Writes: physical, artificial.
    """
    for i in range(p.count[None]):
        rho, mu, v = p.density[i], viscosity[i], p.velocity[i]
        for n in range(nb.wall_count[i]):
            k = nb.wall_index[i, n]
            if k < w.count:
                r_ik = nb.grid.separation(p.position[i], w.position[k])
                # Without pressure; and without sound, which the artificial viscosity goes with.
                friction = wall_pair_acceleration(w, k, r_ik, v, rho, 0.0, mu, fluid, 0.0)
                whole = wall_pair_acceleration(w, k, r_ik, v, rho, 0.0, mu, fluid, sound_speed)
                normal = w.normal[k]
                scale = -weight * ti.static(fluid.rest_density)
                extra = scale * (whole - friction)
                friction *= scale
                physical[k] += friction - friction.dot(normal) * normal
                artificial[k] += extra - extra.dot(normal) * normal
