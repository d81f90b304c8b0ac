"""Watch and change a scene in a browser: a studio that draws what is wished for, and its window.

:mod:`tron.view.studio` has no GUI in it; :mod:`tron.view.window` is its window, by viser. In a notebook
:func:`show` opens one.
"""

from tron.view.opening import Shown, show

__all__ = ["Shown", "show"]
