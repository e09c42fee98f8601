"""What makes the craft's own FMUs."""

from __future__ import annotations

from collections.abc import Mapping

from fmus.build import Recipe, about_model, ordered
from fmus.description import Description
from fmus.documentation import documented, model_text

# A second plant for scenarios/swap.yaml: a heavier craft whose servos overshoot (§4.5.4 saw it on the real one).
HEAVY = {
    "mass": 0.8,
    "izz": 0.0116,
    "actuator_second_order.natural_frequency": 16.0,
    "actuator_second_order.damping_ratio": 0.5,
}


def plant_recipe(values: Mapping[str, float | bool] | None = None) -> Recipe:
    """The plant, with other defaults where `values` says so (a refined model)."""
    import plant.hovercraft as craft
    import plant.planar as planar

    model = craft.Hovercraft()
    about = about_model(
        model.with_values(values or {}),
        "Thrust-vectoring hovercraft on an air table: two tilting propellers with lag and ground effect",
    )
    text = f"<p>An unconnected plant hovers.</p>{model_text(model)}{documented(craft, planar)}"
    return Recipe(("plant_fmu", "HovercraftPlant"), ("plant",), about, text, ordered(values), ("model_fmu",))


def heavy_recipe() -> Recipe:
    """The heavier craft."""
    return plant_recipe(HEAVY)


def controller_recipe() -> Recipe:
    """The controller."""
    from controller.gains import Settings
    from controller.kalman import discrete_model
    from controller.loop import Loop
    from fmus.controller_fmu import DEPENDENCIES, INITIAL_DEPENDENCIES, HovercraftController, controller_ports

    settings = Settings()
    about = Description(
        "Flight controller of the hovercraft: Kalman filter and LQR with tilt saturation",
        controller_ports(settings),
        DEPENDENCIES,
        INITIAL_DEPENDENCIES,
        step=settings.sample_time,
        stop=10.0,
        variable_step=False,
        sampled="sample_time",
    )
    text = documented(Loop, discrete_model, HovercraftController)
    designing = ("controller/synthesis.py", "controller/designer.py")
    slave = ("controller_fmu", "HovercraftController")
    return Recipe(slave, ("plant", "controller"), about, text, without=designing)


def bench_recipe(values: Mapping[str, float | bool] | None = None) -> Recipe:
    """The testing bench, with other defaults where `values` says so."""
    import plant.bench as bench

    model = bench.Bench()
    about = about_model(
        model.with_values(values or {}),
        "Testing bench: one tilting propeller on three load cells, converted by 12 bit and low-passed",
    )
    text = f"<p>An unconnected bench is at rest.</p>{model_text(model)}{documented(bench)}"
    return Recipe(("bench_fmu", "PropellerBench"), ("plant",), about, text, ordered(values), ("model_fmu",))
