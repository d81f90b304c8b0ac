"""Codecs between pictures and latents, one file each."""
