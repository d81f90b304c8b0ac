"""The tracer and its light as Mitsuba integrators, for those whose cameras and films are Mitsuba's.

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

Surfels come from a file (``filename``) or from memory (``surfels``, of :func:`embed`). They are all that is
seen: shapes of the Mitsuba scene are not. Rays go where Mitsuba's sensor and sampler send them, and the
film's filter makes pixels of what they show. Perspective, thin-lens and orthographic sensors are tested;
those that place rays by the bounds of the scene's shapes, such as ``distant``, see nothing. All rays of a
render are traced at once, so memory grows with pixels x samples. Plugins:

``tron_gbuffer`` (:mod:`tron.integrators.gbuffer`): what the surfels are, their harmonics' radiance included.
``tron_guidance`` (:mod:`tron.integrators.guidance`): what they look like under an environment.
``tron_many_lights`` (:mod:`tron.integrators.many_lights`): no surfels, but the Mitsuba scene's own shapes,
path-traced under many environments at once.

Mitsuba wraps what a plugin raises in a RuntimeError of its own; the last line of its message is TRON's.
"""

from tron.integrators.plugin import embed

__all__ = ["embed", "register"]

VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb")


def register() -> None:
    """Make the plugins known to Mitsuba for the active variant; safe to repeat, and due again after a change.

    Raises:
        TronError: no variant is set, or one that the tracer does not run in.
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
