"""The material of every surface: glTF's metallic-roughness, which keeps all light that it does not absorb.

One definition for the path tracer (:mod:`tron.brdf.bsdf`), and for surfels, bounces, bakes and fits, which
know its shares of light (:mod:`tron.brdf.reflectance`).
"""
