"""Colours of lines and bars in charts."""

LINE_COLOURS = ("#3d85c6", "#d9822b", "#4a9d5f", "#a064c8", "#c0504d", "#7f7f7f")
