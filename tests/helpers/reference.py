"""The sums of the physics core by brute force, in numpy and double precision.

Written from the equations (Eqs. 1-3, 6-8, 10, 12-16, with the corrections that the docstrings of
the core name), every pair and every tensor spelled out: no lists, no shared helpers, no Taichi.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np


def wendland(r: np.ndarray, support: float) -> np.ndarray:
    """W(r) = 21/(2 pi R^3) (1 - q)^4 (1 + 4 q) for q = r/R < 1, else 0 [1/m^3]."""
    q = np.asarray(r) / support
    return np.where(q < 1.0, 21.0 / (2.0 * np.pi * support**3) * (1 - q) ** 4 * (1 + 4 * q), 0.0)


def wendland_gradient(r_ij: np.ndarray, support: float) -> np.ndarray:
    """Gradient of W with respect to x_i [1/m^4], shape (..., 3): dW/dq = -20 q (1 - q)^3 W(0)."""
    r = np.linalg.norm(r_ij, axis=-1)
    q = r / support
    derivative = np.where(
        q < 1.0, -20.0 * q * (1 - q) ** 3 * 21.0 / (2.0 * np.pi * support**4), 0.0
    )
    unit = r_ij / np.where(r > 0.0, r, 1.0)[..., None]
    return derivative[..., None] * unit


def separations(x: np.ndarray, y: np.ndarray, period: np.ndarray | None = None) -> np.ndarray:
    """x_i - y_j to the nearest image [m], shape (n, m, 3)."""
    r = x[:, None, :] - y[None, :, :]
    for axis, length in enumerate(np.zeros(3) if period is None else period):
        if length > 0.0:
            images = np.stack([r[..., axis] + k * length for k in (-2, -1, 0, 1, 2)])
            nearest = np.abs(images).argmin(axis=0)
            r[..., axis] = np.take_along_axis(images, nearest[None], axis=0)[0]
    return r


def between(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Distances of points (n, k) to points (m, k), (n, m)."""
    return np.linalg.norm(x[:, None] - y[None], axis=2)


def proxy_volumes(y: np.ndarray, support: float, period: np.ndarray | None = None) -> np.ndarray:
    """Eq. 3 with gamma = 1: V_k = 1 / sum_l W(y_k - y_l), itself included [m^3]."""
    return 1.0 / wendland(np.linalg.norm(separations(y, y, period), axis=-1), support).sum(axis=1)


def casson(shear_rate: np.ndarray, eta: float, tau_y: float, n: float) -> np.ndarray:
    """Eq. 8 with exp(-sqrt(n g)) [Pa s]; g > 0."""
    g = np.asarray(shear_rate, dtype=float)
    return (np.sqrt(eta) - np.sqrt(tau_y / g) * np.expm1(-np.sqrt(n * g))) ** 2


def shear_rate(gradient: np.ndarray) -> np.ndarray:
    """sqrt(2 D:D) [1/s] of velocity gradients (n, 3, 3); D symmetric and free of its trace."""
    d = 0.5 * (gradient + np.swapaxes(gradient, 1, 2))
    d = d - np.trace(d, axis1=1, axis2=2)[:, None, None] / 3.0 * np.eye(3)
    return np.sqrt(2.0 * np.einsum("nab,nab->n", d, d))


@dataclass
class Blood:
    """A state and its constants; every sum is a method, every pair is summed."""

    x: np.ndarray
    v: np.ndarray
    y: np.ndarray
    """Proxies [m], shape (m, 3)."""
    spacing: float
    support: float
    rest_density: float
    sound_speed: float
    background: float
    alpha: float
    damping: float
    thin: float
    eta: float
    tau_y: float
    n: float
    """Casson's constants; tau_y = 0 is Newtonian."""
    factors: dict[str, float]
    """Calibration: mass, viscosity, gradient and those of the wall."""
    period: np.ndarray = field(default_factory=lambda: np.zeros(3))
    curvature: np.ndarray | float = 0.0
    """Of the wall at each proxy, times h_s, (m,)."""

    def __post_init__(self) -> None:
        self.x, self.v, self.y = (np.asarray(a, dtype=np.float64) for a in (self.x, self.v, self.y))
        self.r = separations(self.x, self.x, self.period)
        self.r_wall = separations(self.x, self.y, self.period)
        self.volume = proxy_volumes(self.y, self.support, self.period)
        self.friction_volume = self.volume * (1.0 + 0.85 * self.curvature**2)
        self.mass = self.factors["mass"]
        # 0.01 h_s^2 with h_s = R/2.
        self.eps = 0.01 * (self.support / 2.0) ** 2
        self.rho = self.density()
        self.p = self.pressure(self.rho)

    @cached_property
    def grad(self) -> np.ndarray:
        """Gradient of W_ij, shape (n, n, 3)."""
        return wendland_gradient(self.r, self.support)

    @cached_property
    def grad_wall(self) -> np.ndarray:
        """Gradient of W_ik, shape (n, m, 3)."""
        return wendland_gradient(self.r_wall, self.support)

    @cached_property
    def v_ij(self) -> np.ndarray:
        """v_i - v_j [m/s], shape (n, n, 3)."""
        return self.v[:, None, :] - self.v[None, :, :]

    def density(self) -> np.ndarray:
        """Eq. 2 [kg/m^3]; the pair of a particle with itself is in the sum."""
        blood = wendland(np.linalg.norm(self.r, axis=-1), self.support).sum(axis=1)
        wall = wendland(np.linalg.norm(self.r_wall, axis=-1), self.support) @ self.volume
        return self.mass * blood + self.factors["wall_density"] * self.rest_density * wall

    def pressure(self, rho: np.ndarray) -> np.ndarray:
        """Eq. 14, bounded from below by zero [Pa]."""
        b = self.rest_density * self.sound_speed**2 / 7.0
        return np.maximum(0.0, b * ((rho / self.rest_density) ** 7 - 1.0) + self.background)

    def internal_energy(self) -> float:
        """Sum of m u with du/drho = p/rho^2 [J]; constant where the pressure is bounded.

        Every pressure force carries the gradient's calibration, so the energy does.
        """
        b = self.rest_density * self.sound_speed**2 / 7.0
        lowest = self.rest_density * max(0.0, 1.0 - self.background / b) ** (1.0 / 7.0)
        rho = np.maximum(self.rho, lowest)
        c = rho / self.rest_density
        u = b / self.rest_density * (c**6 / 6.0 + 1.0 / c) - self.background / rho
        return float(self.factors["gradient"] * self.mass * u.sum())

    def kinetic_energy(self) -> float:
        """Sum of m v^2/2 [J]."""
        return float(0.5 * self.mass * (self.v**2).sum())

    def velocity_gradient(self, weights: np.ndarray) -> np.ndarray:
        """Eq. 10 with the wall at rest, dv_a/dx_b [1/s]; `weights` are the volumes of blood."""
        blood = np.einsum("ija,ijb,j->iab", -self.v_ij, self.grad, weights)
        wall = np.einsum("ia,ikb,k->iab", -self.v, self.grad_wall, self.volume)
        return self.factors["gradient"] * (blood + self.factors["wall_gradient"] * wall)

    def viscosity(self, nested: bool = False) -> np.ndarray:
        """Eq. 8 of the shear rate [Pa s]; rest volumes, or m/rho_j in the nested form."""
        if self.tau_y == 0.0:
            return np.full(len(self.x), self.eta)
        weights = self.mass / self.rho if nested else np.full_like(self.rho, self.spacing_volume)
        return casson(shear_rate(self.velocity_gradient(weights)), self.eta, self.tau_y, self.n)

    @property
    def spacing_volume(self) -> float:
        """Rest volume m/rho_0 [m^3]."""
        return self.mass / self.rest_density

    def density_rate(self) -> np.ndarray:
        """Rate of the density of Eq. 2 over rho_0, the wall at rest [1/s]."""
        blood = self.spacing_volume * np.einsum("ija,ija->i", self.v_ij, self.grad)
        wall = np.einsum("ia,ika,k->i", self.v, self.grad_wall, self.volume)
        return blood + self.factors["wall_density"] * wall

    def pressure_term(self) -> np.ndarray:
        """p/rho^2 and the damping of sound, zeta c h_s (d(rho/rho_0)/dt)/rho, not below zero."""
        damping = self.damping * self.sound_speed * (self.support / 2.0) * self.density_rate()
        return np.maximum(0.0, self.p / self.rho**2 + damping / self.rho)

    def concentration_gradient(self) -> np.ndarray:
        """Sum of V f grad W with f = 1 + 0.2 (W/W(d))^4, and of the wall's with its gamma [1/m]."""
        w = wendland(np.linalg.norm(self.r, axis=-1), self.support)
        f = 1.0 + 0.2 * (w / wendland(np.array(self.spacing), self.support)) ** 4
        blood = self.spacing_volume * np.einsum("ij,ija->ia", f, self.grad)
        wall = np.einsum("k,ika->ia", self.volume, self.grad_wall)
        return self.factors["gradient"] * (blood + self.factors["wall_concentration"] * wall)

    def shifting(self, factor: float, frequency: float) -> np.ndarray:
        """Velocity beside the flow [m/s], in so many steps a time [1/s]."""
        h = self.support / 2.0
        weights = np.full_like(self.rho, self.spacing_volume)
        rate = shear_rate(self.velocity_gradient(weights))
        w = -np.minimum(factor * rate, 0.2 * frequency)[:, None] * h**2
        w = w * self.concentration_gradient()
        size = np.linalg.norm(w, axis=1)
        part = self.surrounded(self.rho) * np.minimum(1.0, rate * h / np.maximum(size, 1e-30))
        return part[:, None] * w

    def pressure_acceleration(self) -> np.ndarray:
        """Eq. 13, with the calibration of the gradient [m/s^2]."""
        q = self.factors["gradient"] * self.pressure_term()
        return -self.mass * np.einsum("ij,ija->ia", q[:, None] + q[None, :], self.grad)

    def surrounded(self, rho: np.ndarray) -> np.ndarray:
        """0 under 0.90 of the rest density, 1 over 0.95."""
        return np.clip((rho / self.rest_density - 0.90) / 0.05, 0.0, 1.0)

    def alpha_at(self, rho: np.ndarray) -> np.ndarray:
        """Monaghan's alpha: everywhere, and of thin blood beside it."""
        return self.alpha + self.thin * (1.0 - self.surrounded(rho))

    def artificial_acceleration(self) -> np.ndarray:
        """Monaghan (1992): Pi = -alpha h_s c (v.r)/(r^2 + eps)/mean rho, approaching pairs only."""
        vr = np.minimum(0.0, np.einsum("ija,ija->ij", self.v_ij, self.r))
        mean = 0.5 * (self.rho[:, None] + self.rho[None, :])
        mu = (self.support / 2.0) * vr / ((self.r**2).sum(-1) + self.eps)
        pi = -self.alpha_at(mean) * self.sound_speed * mu / mean
        return -self.mass * np.einsum("ij,ija->ia", pi, self.grad)

    def viscous_acceleration(self) -> np.ndarray:
        """Morris (1997) with the harmonic mean of the viscosities [m/s^2]."""
        mu = self.viscosity()
        mean = 2.0 * mu[:, None] * mu[None, :] / (mu[:, None] + mu[None, :])
        rg = np.einsum("ija,ija->ij", self.r, self.grad) / ((self.r**2).sum(-1) + self.eps)
        rho2 = self.rho[:, None] * self.rho[None, :]
        factor = self.factors["viscosity"] * self.mass * 2.0 * mean / rho2 * rg
        return np.einsum("ij,ija->ia", factor, self.v_ij)

    def nested_acceleration(self) -> np.ndarray:
        """Eqs. 6, 7, 10, 12: sum_j m (tau_i + tau_j)/(rho_i rho_j) . grad W, tau = 2 mu D."""
        gradient = self.velocity_gradient(self.mass / self.rho)
        d = 0.5 * (gradient + np.swapaxes(gradient, 1, 2))
        d = d - np.trace(d, axis1=1, axis2=2)[:, None, None] / 3.0 * np.eye(3)
        tau = 2.0 * self.viscosity(nested=True)[:, None, None] * d
        total = np.zeros_like(self.x)
        for i in range(len(self.x)):
            pair = (tau[i] + tau) / (self.rho[i] * self.rho)[:, None, None]
            total[i] = (
                self.factors["gradient"] * self.mass * np.einsum("jab,jb->a", pair, self.grad[i])
            )
        return total

    def wall_pressure_acceleration(self) -> np.ndarray:
        """Eq. 15 with one p_i/rho_i^2 and the calibration of the gradient [m/s^2]."""
        psi = (
            self.factors["gradient"]
            * self.factors["wall_density"]
            * self.rest_density
            * self.volume
        )
        return -self.pressure_term()[:, None] * np.einsum("k,ika->ia", psi, self.grad_wall)

    def wall_artificial_acceleration(self) -> np.ndarray:
        """The artificial term of Eq. 15: rho_k = rho_i, v_k = 0, approaching pairs only."""
        psi = self.factors["wall_density"] * self.rest_density * self.volume
        vr = np.minimum(0.0, np.einsum("ia,ika->ik", self.v, self.r_wall))
        mu = (self.support / 2.0) * vr / ((self.r_wall**2).sum(-1) + self.eps)
        pi = -self.alpha_at(self.rho[:, None]) * self.sound_speed * mu / self.rho[:, None]
        return -np.einsum("ik,k,ika->ia", pi, psi, self.grad_wall)

    def wall_friction_acceleration(self, nested: bool = False) -> np.ndarray:
        """Eq. 16 in Morris' form: mu_k = mu_i, rho_k = rho_i, v_k = 0 [m/s^2]."""
        psi = self.factors["wall_friction"] * self.rest_density * self.friction_volume
        rg = np.einsum("ika,ika->ik", self.r_wall, self.grad_wall)
        rg = rg / ((self.r_wall**2).sum(-1) + self.eps)
        factor = 2.0 * self.viscosity(nested) / self.rho**2 * (rg @ psi)
        return factor[:, None] * self.v

    def acceleration(self, gravity: np.ndarray, nested: bool = False) -> np.ndarray:
        """Eq. 5 per unit mass: every term and gravity [m/s^2]."""
        viscous = self.nested_acceleration() if nested else self.viscous_acceleration()
        return (
            self.pressure_acceleration()
            + self.artificial_acceleration()
            + viscous
            + self.wall_pressure_acceleration()
            + self.wall_artificial_acceleration()
            + self.wall_friction_acceleration(nested)
            + gravity
        )
