"""The cell's parameters as bounds for MuJoCo's system identification (``mujoco.sysid``).

Parameters of causes are free within three standard deviations, all others are frozen. The effect of
a parameter on the patched model is determined numerically: the model is also patched at both
bounds, and each attribute is interpolated (a parabola through both bounds and the value). Where the
parameter is a compliance, stiffnesses and gains are interpolated as what is linear in it, such as
1 / stiffness.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gapbridge.bridge.cell import Cell
from gapbridge.bridge.patch.changes import changes_of
from gapbridge.bridge.patch.mjcf import Mjcf
from gapbridge.bridge.patch.model_format import PatchOptions
from gapbridge.core.arrays import Array
from gapbridge.core.effects import CATALOGUE
from gapbridge.core.model import Model

SIGMAS = 3.0  # from the value to each bound
COMPLIANCES = ("rad/Nm", "1/(N m2)")  # units of parameters that a stiffness is the inverse of
LEAST_SHARE = 0.1  # lower bound of a compliance per value: at 0 its spring is infinitely stiff
# of attributes that a compliance changes: number ** -power is linear (of damping, quadratic) in it
POWERS = {
    "stiffness": (1.0, 1 / 2, 1 / 3),  # a polynomial in the angle
    "damping": (2.0,),  # that of a spring
    "gainprm": (1.0,),
    "biasprm": (0.0, 1.0, 2.0),
}
MODELS = Mjcf.suffixes
SUFFIXES = (".py", ".yaml", ".yml")
ATTRIBUTES = {  # of a MjSpec's elements, that a patch can change
    "body": ("pos", "quat", "mass", "ipos", "inertia"),
    "joint": ("stiffness", "damping", "frictionloss", "armature", "range"),
    "site": ("pos", "quat"),
    "actuator": ("delay", "nsample", "dynprm", "gainprm", "biasprm"),
}


@dataclass(frozen=True)
class Bounds:
    """One parameter of the cell with its bounds, SI; sign as in docs/conventions.md."""

    name: str
    value: float
    lower: float
    upper: float
    free: bool

    def state(self) -> dict[str, Any]:
        """Return the state of a ``mujoco.sysid.Parameter``."""
        return {
            "name": self.name, "nominal": [self.value], "value": [self.value],
            "min_value": [self.lower], "max_value": [self.upper], "frozen": not self.free,
        }  # fmt: skip


@dataclass(frozen=True)
class _Parameter:
    """One parameter and the terms (of one effect at one site) whose sum it is."""

    bounds: Bounds
    terms: tuple[int, ...]  # indices into the model's terms; the last one is varied
    index: int  # in the term's values
    compliance: bool

    def varied(self, model: Model, value: float) -> Model:
        """Return the model with another value."""
        last = self.terms[-1]
        values = np.array(model.terms[last].values)
        values[self.index] += value - self.bounds.value
        terms = list(model.terms)
        terms[last] = terms[last].with_values(values)
        return replace(model, terms=tuple(terms))


def parameters_text(path: Path, cell: Cell, options: PatchOptions, suffix: str) -> str:
    """Return the bounds of a cell's parameters for the model at ``path``.

    ``suffix`` .yaml: as ``ParameterDict.load_from_disk`` reads them; .py: a module whose
    ``parameters()`` gives them with modifiers for the patched model. Raises InputError as the patch
    itself does.
    """
    numbers = list(_numbers(cell))
    if suffix != ".py":
        import yaml

        states = {n.bounds.name: n.bounds.state() for n in numbers}
        return str(yaml.safe_dump(states, sort_keys=False))
    plain = replace(options, folder=None)
    at_value = _attributes(path, cell.model, plain)
    changes: dict[str, list[list[Any]]] = {}
    for number in numbers:
        bounds = number.bounds
        if bounds.free:
            lower, upper = (
                _attributes(path, number.varied(cell.model, value), plain)
                for value in (bounds.lower, bounds.upper)
            )
            changes[bounds.name] = list(_between(at_value, lower, upper, number.compliance))
    return _module(path, cell, numbers, changes)


def _numbers(cell: Cell) -> Iterator[_Parameter]:
    """Yield all parameters of the cell's effects that act on the arm."""
    model, sigma = cell.model, _sigmas(cell)
    sites: dict[tuple[str, Any], list[int]] = {}
    for i, term in enumerate(model.terms):
        if not term.stand_in and CATALOGUE[term.effect].of_the_arm:
            sites.setdefault((term.effect, term.site), []).append(i)
    for (effect, site), indices in sites.items():
        for k, parameter in enumerate(CATALOGUE[effect].parameters(model.arm, site)):
            name = CATALOGUE[effect].label(site, parameter)
            value = sum(sum(model.terms[i].values[k : k + 1]) for i in indices)
            std = sigma.get(name)
            half_width = 0.0 if std is None else SIGMAS * std
            lower = max(value - half_width, parameter.lower)
            upper = min(value + half_width, parameter.upper)
            compliance = parameter.unit in COMPLIANCES
            if compliance:
                lower = max(lower, LEAST_SHARE * value)
            free = half_width > 0 and lower < upper and not (compliance and value <= 0)
            bounds = Bounds(name, value, lower, upper, free)
            yield _Parameter(bounds, tuple(indices), k, compliance)


def _sigmas(cell: Cell) -> dict[str, float]:
    """Return the standard deviation of each diagnosed or fitted parameter by name."""
    spread = cell.spread
    stds = dict(zip(spread.names, np.sqrt(np.maximum(np.diag(spread.covariance), 0)), strict=True))
    for cause in cell.causes:
        stds |= {p.name: p.std for p in cause.parameters if p.std}
    return {name: float(value) for name, value in stds.items() if value > 0}


def _attributes(path: Path, model: Model, options: PatchOptions) -> dict[tuple[str, ...], Array]:
    """Return all attributes of the patched model that a patch can change, by element."""
    import mujoco

    text = Mjcf().patch(path, changes_of(model), options, ()).text
    spec = mujoco.MjSpec.from_string(text)
    elements = {
        "body": spec.bodies, "joint": spec.joints, "site": spec.sites, "actuator": spec.actuators,
    }  # fmt: skip
    attributes: dict[tuple[str, ...], Array] = {
        (kind, element.name, attribute): np.atleast_1d(getattr(element, attribute)).astype(float)
        for kind, group in elements.items()
        for element in group
        for attribute in ATTRIBUTES[kind]
        if element.name
    }
    attributes["option", "", "gravity"] = np.array(spec.option.gravity)
    return attributes


def _between(
    middle: Mapping[tuple[str, ...], Array], lower: Mapping[tuple[str, ...], Array],
    upper: Mapping[tuple[str, ...], Array], compliance: bool,
) -> Iterator[list[Any]]:  # fmt: skip
    """Yield the changed attributes: kind, name, attribute, powers, change at lower, at upper.

    A power: that of the number's inverse whose changes are stated, 0 where it is the number itself.
    """
    for key, value in middle.items():
        low, high = lower.get(key, value), upper.get(key, value)
        if np.array_equal(low, value, True) and np.array_equal(high, value, True):
            continue
        powers = np.zeros(len(value))
        if compliance:
            known = np.array(POWERS.get(key[2], ()))[: len(value)]
            powers[: len(known)] = known
            powers[(low * value <= 0) | (high * value <= 0)] = 0.0
        middle_number = _inverse(value, powers)
        steps = [np.nan_to_num(_inverse(v, powers) - middle_number).tolist() for v in (low, high)]
        yield [*key, powers.tolist(), *steps]


def _inverse(numbers: Array, powers: Array) -> Array:
    """Return the sizes of numbers to their negative powers; as they are where a power is 0."""
    sizes = np.where(powers > 0, np.abs(numbers), 1.0)
    return np.where(powers > 0, sizes**-powers, numbers)


def _module(
    path: Path, cell: Cell, numbers: list[_Parameter], changes: Mapping[str, list[list[Any]]]
) -> str:
    bounds = "\n".join(
        f"    {n.bounds.name!r}: ({n.bounds.value!r}, {n.bounds.lower!r}, {n.bounds.upper!r}, "
        f"{n.bounds.free}),"
        for n in numbers
    )
    changes_text = "\n".join(
        f"    {name!r}: [\n" + "".join(f"        {tuple(row)!r},\n" for row in rows) + "    ],"
        for name, rows in changes.items()
    )
    model, origin = json.dumps(path.name), json.dumps(str(cell.path.name))
    return TEMPLATE.format(model=model, cell=origin, bounds=bounds, changes=changes_text)


TEMPLATE = '''"""Bounds for MuJoCo's sysid, of {model} patched with {cell}; by gapbridge.

    from mujoco import sysid
    bounds = parameters()
    sysid.apply_param_modifiers(bounds, mujoco.MjSpec.from_file(<the patched model>))

Free: parameters of a diagnosis or calibration, within three standard deviations. SI units.
"""

import numpy as np

BOUNDS = {{  # value, lower, upper, free
{bounds}
}}
CHANGES = {{  # kind, name, attribute of the patched model; powers; by how much at lower, at upper
{changes}
}}


def shifted(number, change, power):
    """Return a number that changes, or whose inverse to a power changes, as a stiffness does."""
    if not power:
        return number + change
    return np.copysign((abs(number) ** -power + change) ** (-1 / power), number)


def modifier(name):
    """Return what writes a parameter into a spec of the patched model."""
    value, lower, upper, _ = BOUNDS[name]
    a, b = lower - value, upper - value

    def modify(spec, parameter):
        x = float(np.ravel(parameter.value)[0]) - value
        for kind, element, attribute, powers, low, high in CHANGES.get(name, ()):
            target = getattr(spec, kind) if kind == "option" else getattr(spec, kind)(element)
            change = np.zeros(len(low))  # a parabola through 0 at x = 0, low at a, high at b
            if a:
                change = change + np.array(low) * (x * (x - b) / (a * (a - b)) if b else x / a)
            if b:
                change = change + np.array(high) * (x * (x - a) / (b * (b - a)) if a else x / b)
            nominal = getattr(target, attribute)
            if attribute == "nsample":
                setattr(target, attribute, int(nominal + max(0, *low, *high)))
                continue
            moved = np.array([shifted(*number) for number in zip(
                np.ravel(nominal).astype(float), change, powers, strict=True)])
            setattr(target, attribute, float(moved[0]) if np.ndim(nominal) == 0 else moved)

    return modify


def parameters():
    """Return the mujoco.sysid.ParameterDict."""
    from mujoco import sysid

    bounds = sysid.ParameterDict()
    for name, (value, lower, upper, free) in BOUNDS.items():
        bounds.add(sysid.Parameter(name, value, lower, upper, frozen=not free,
                                   modifier=modifier(name) if free else None))
    return bounds
'''
