"""The neural renderer, measured: `tron-eval benchmark=renderer`."""
