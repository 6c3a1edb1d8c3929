"""The catalogue: built-in effects, effects from files that the user names, and effects of installed packages."""

from __future__ import annotations

import copyreg
import difflib
import hashlib
import importlib.util
import sys
from collections.abc import Iterable
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType

from firmware_iface.errors import InputError
from trainer.effects import camera_in_time, drive, light_source, modulation, panel, pupil, sensor
from trainer.effects.definition import Effect, apart
from trainer.effects.own_effect import line_in_file

ENTRY_POINTS = "hololoop.effects"

BUILT_IN: tuple[Effect, ...] = (
    drive.phase_response,
    drive.phase_nonuniformity,
    drive.crosstalk,
    drive.drivers,
    modulation.amplitude_modulation,
    modulation.polarisation_leak,
    modulation.slow_response,
    modulation.phase_ripple,
    panel.zero_order,
    panel.illumination,
    panel.panel_wavefront,
    panel.coherent_ghost,
    pupil.distance,
    pupil.wavelength,
    pupil.pupil_aberration,
    pupil.iris,
    light_source.temporal_coherence,
    light_source.source_lines,
    light_source.spatial_coherence,
    sensor.sensor_blur,
    sensor.misregistration,
    sensor.vignetting,
    sensor.stray_light,
    sensor.sensor_response,
    sensor.laser_drift,
    sensor.ghost,
    camera_in_time.vibration,
    camera_in_time.frame_motion,
    camera_in_time.fixed_pattern,
)

FORMER_MODULES = {
    "trainer.pull": "trainer.effects.pull",
    "trainer.stages": "trainer.prediction.stages",
    "trainer.starts": "trainer.effects.starts",
    "trainer.scene": "trainer.model.model_stages",
}

Catalogue = dict[str, Effect]

_files: dict[str, Catalogue] = {}  # effect files, read for effects that came from another process


def _named(name: str, source: str, is_apart: bool = False) -> Effect:
    one = next((e for e in BUILT_IN if e.name == name), None) or _of_source(name, source)
    return apart(one) if is_apart else one


def _of_source(name: str, source: str) -> Effect:
    if source not in _files:
        _files[source] = {e.name: e for e in load_effects(Path(source))}
    return _files[source].get(name) or catalogue()[name]


# An effect travels to other processes by name: the function of a decorated effect cannot be pickled.
copyreg.pickle(Effect, lambda one: (_named, (one.name, one.source, one.in_common is not None)))


def forget_effect_files() -> None:
    """Drop the effect files that an earlier run has read in this process: they may have changed since then."""
    _files.clear()


def catalogue(files: Iterable[Path] = ()) -> Catalogue:
    """Every known effect by name, in the order in which light meets them; users' own after the built-in ones.

    Parameters
    ----------
    files : iterable of Path
        Python files that define further effects.

    Returns
    -------
    dict of str to Effect

    Raises
    ------
    InputError
        When a file cannot be loaded, defines no effect, or defines one whose name is used already.
    """
    known: Catalogue = {e.name: e for e in BUILT_IN}
    for point in entry_points(group=ENTRY_POINTS):
        _add(known, _of_entry_point(point), f"entry point '{point.name}'")
    for path in files:
        _add(known, load_effects(path), str(path))
    return known


def find_effect(known: Catalogue, name: str) -> Effect:
    """The effect of that name.

    Raises
    ------
    InputError
        For an unknown name, with the nearest known one.
    """
    if name in known:
        return known[name]
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.4)
    hint = f"did you mean '{near[0]}'?" if near else "see 'hololoop-trainer effects' for the list"
    raise InputError(f"unknown effect '{name}': {hint}")


def _of_entry_point(point: EntryPoint) -> list[Effect]:
    """The effects that an installed package offers: a module's, one effect, or a list of them."""
    where = f"entry point '{point.name}' ({point.value})"
    try:
        loaded = point.load()
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # SystemExit, too
        raise InputError(
            f"{where} cannot be loaded ({type(error).__name__}: {error}): repair or uninstall its package"
        ) from error
    found = _defined_in(loaded) if isinstance(loaded, ModuleType) else loaded
    if isinstance(found, Effect):
        return [found]
    if not isinstance(found, list | tuple) or not found:
        raise InputError(
            f"{where} gives no effect: let it name a module with effects, an effect, or a list of them"
        )
    return list(found)


def _defined_in(module: ModuleType) -> list[Effect]:
    """A module's own effects."""
    return [v for v in vars(module).values() if isinstance(v, Effect) and v not in BUILT_IN]


def load_effects(path: Path) -> list[Effect]:
    """The effects that a Python file defines.

    Raises
    ------
    InputError
        When it cannot be run (with the line), or defines no effect.
    """
    if not path.is_file():
        raise InputError(f"effects file {path} is not there: give the path of a Python file")
    name = "hololoop_effects_" + hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:12]
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise InputError(f"effects file {path} is not a Python file: its name must end in .py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    for former, present in FORMER_MODULES.items():  # files that were written for version 0.1 import these
        sys.modules.setdefault(former, importlib.import_module(present))
    try:
        spec.loader.exec_module(module)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # SystemExit, too: the file does not end this program
        line = line_in_file(error, spec.origin or str(path))
        where = f"effects file {path}" + ("" if line is None else f", line {line}")
        if isinstance(error, InputError):
            raise InputError(f"{where}: {error}") from error
        if isinstance(error, SystemExit):
            raise InputError(
                f"{where}: it ends the program (SystemExit): let the file define effects and nothing else"
            ) from error
        raise InputError(f"{where}: {type(error).__name__}: {error}") from error
    own = _defined_in(module)
    if not own:
        raise InputError(
            f"effects file {path} defines no effect: decorate a function with trainer.effects.effect"
        )
    return own


def _add(known: Catalogue, effects: list[Effect], where: str) -> None:
    for one in effects:
        if not isinstance(one, Effect):
            raise InputError(f"{where} gives {type(one).__name__}, not an effect: use trainer.effects.effect")
        if one.name in known:
            raise InputError(
                f"{where} defines '{one.name}', which is already the name of an effect: rename it"
            )
        known[one.name] = one
