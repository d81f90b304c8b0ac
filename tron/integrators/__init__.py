"""The tracer and its shading as Mitsuba integrators, for use with Mitsuba's cameras and films.

    from tron.integrators import register
    from tron.runtime import activate

    activate("llvm_ad_rgb")
    register()
    scene = mi.load_dict({
        "type": "scene",
        "integrator": {"type": "tron_guidance", "filename": "scene.ply", "buffer": "pbr"},
        "sensor": {"type": "thinlens", ...},
        "light": {"type": "envmap", "filename": "light.exr", "to_world": ...},
    })
    image = mi.render(scene, spp=16)

Surfels come from a file (``filename``) or from memory (``surfels``, by :func:`embed`). Only surfels are seen,
not the shapes of the Mitsuba scene. Mitsuba's sensor and sampler generate the rays, and the film's filter
turns their colours into pixels. Perspective, thin-lens and orthographic sensors are tested; sensors that
place rays by the bounds of the scene's shapes, such as ``distant``, see nothing. All rays of a render are
traced at once, so memory grows with pixels x samples. Plugins:

``tron_gbuffer`` (:mod:`tron.integrators.gbuffer`): the surfels' G-buffer, with the radiance of harmonics.
``tron_guidance`` (:mod:`tron.integrators.guidance`): the surfels shaded under an environment.
``tron_many_lights`` (:mod:`tron.integrators.many_lights`): no surfels, but the Mitsuba scene's own shapes,
path-traced under many environments at once.

Mitsuba wraps a plugin's errors in its own RuntimeError; the last line of the message is TRON's.
"""

from tron.integrators.plugin import embed

__all__ = ["embed", "register"]

VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb")


def register() -> None:
    """Register the plugins for the active Mitsuba variant; safe to repeat, needed again after a change of it.

    Raises:
        TronError: no variant is set, or the tracer does not support it.
    """
    import mitsuba as mi

    from tron.errors import TronError
    from tron.integrators.gbuffer import GBufferAppearance
    from tron.integrators.guidance import GuidanceAppearance
    from tron.integrators.many_lights import NAME, many_lights_class
    from tron.integrators.plugin import plugin_class

    if mi.variant() not in VARIANTS:
        raise TronError(
            f"the integrators do not run in Mitsuba's variant {mi.variant()}",
            mend=f"call tron.runtime.activate first, with one of {', '.join(VARIANTS)}",
        )
    for name, appearance in {"tron_gbuffer": GBufferAppearance, "tron_guidance": GuidanceAppearance}.items():
        mi.register_integrator(name, plugin_class(name, appearance))
    mi.register_integrator(NAME, many_lights_class())
