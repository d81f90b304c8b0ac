"""The material of every surface: glTF's metallic-roughness, made energy-conserving.

One definition serves the path tracer (:mod:`tron.brdf.bsdf`), and surfels, bounces, bakes and fits, which use
its albedos (:mod:`tron.brdf.reflectance`).
"""
