"""Entry points of the library; the only place in `tron` that knows Hydra."""
