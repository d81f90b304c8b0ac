"""Controls that viser lacks, as HTML with scripts: draggable pictures, and a panel that folds.

The light's picture and the divider of a picture of two move the slider of the same value, as a hand would,
and follow it: the server knows the slider alone, and every client sees what another one drags.
"""

from __future__ import annotations

import base64
import html

import cv2
import numpy as np

from tron.errors import TronError

QUALITY = 88
"""Of the picture's JPEG."""
NARROW = 576
"""Pixels of a page up to which viser lays its panel over the picture."""

_SLIDER = """
const field = () => document.getElementById('%(slider)s')
  ?.parentElement.querySelector('input:not([type=hidden])');
const now = () => parseFloat(field()?.value);
const set = value => {
  const to = field();
  if (!to) return;
  Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, 'value').set.call(to, value);
  to.dispatchEvent(new Event('input', {bubbles: true}));
};
const follow = step => { const again = () => { if (step()) requestAnimationFrame(again); }; again(); };
const drag = (box, began, moved) => {
  let start = null;
  box.onpointerdown = e => { box.setPointerCapture(e.pointerId); start = [e.clientX, began()]; };
  box.onpointermove = e => { if (start) moved(e.clientX - start[0], start[1]); };
  box.onpointerup = box.onpointercancel = () => { start = null; };
};
"""

_PANORAMA = """
const box = this.parentElement;
box.style.backgroundImage = `url(${this.src})`;
drag(box, now, (by, from) => {
  const turn = Math.round(from - 360 * by / box.clientWidth);
  set(((turn % 360) + 360) % 360);
});
follow(() => {
  const turn = now();
  if (!isNaN(turn)) box.style.backgroundPositionX = `${-turn / 360 * box.clientWidth}px`;
  return box.isConnected;
});
"""

_DIVIDER = """
const anchor = this, bar = document.createElement('div');
bar.className = 'tron-divider';
bar.title = 'drag: what is left of it is %(words)s';
bar.style.cssText = 'position:fixed;width:18px;margin-left:-9px;cursor:ew-resize;touch-action:none;z-index:2;'
  + 'display:flex;align-items:center;justify-content:center';
bar.innerHTML = '<div style="width:14px;height:44px;border-radius:7px;background:#fffd;'
  + 'box-shadow:0 0 6px #0008;color:#555;font:11px/44px sans-serif;text-align:center">&#8596;</div>';
document.body.appendChild(bar);
const whole = () => document.querySelector('canvas').getBoundingClientRect();
drag(bar, now, (by, from) => set(Math.min(Math.max(from + 100 * by / whole().width, 0), 100).toFixed(1)));
follow(() => {
  if (!anchor.isConnected) { bar.remove(); return false; }
  const at = whole(), value = now();
  if (!isNaN(value)) bar.style.left = `${at.left + value / 100 * at.width}px`;
  bar.style.top = `${at.top}px`;
  bar.style.height = `${at.height}px`;
  return true;
});
"""
_FOLD = """
let panel = this.parentElement;
while (panel && getComputedStyle(panel).position !== 'fixed') panel = panel.parentElement;
const narrow = matchMedia('(max-width: %(narrow)dpx)').matches;
const handle = panel?.querySelector('[style*="cursor: pointer"]');
if (narrow && handle && !window.tronFolded) { window.tronFolded = true; handle.click(); }
"""
_PIXEL = "data:image/gif;base64,R0lGODlhAQABAIAAAAAAAP///yH5BAEAAAAALAAAAAABAAEAAAIBRAA7"


def panorama(image: np.ndarray, slider: str) -> str:
    """HTML of a light's picture, to be turned by dragging it sideways.

    Args:
        image: (H, W, 3) uint8, the whole turn, as :meth:`tron.view.stage.Stage.thumbnail` gives it.
        slider: viser's id of the slider of its turn, degrees.
    """
    encoded, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not encoded:
        raise TronError("the light's picture cannot be encoded")
    source = "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()
    style = (
        f"aspect-ratio:{image.shape[1]}/{image.shape[0]};background:0 0/100% 100% repeat-x;cursor:ew-resize;"
        "touch-action:none;border-radius:4px;margin:0 0.5em 0.4em"
    )
    inside = _run(source, _SLIDER % {"slider": slider} + _PANORAMA)
    return f'<div class="tron-panorama" title="drag to turn the light" style="{style}">{inside}</div>'


def divider(slider: str, words: str) -> str:
    """HTML of a bar over the picture, to be dragged sideways.

    Args:
        slider: viser's id of the slider of its place, percent of the width.
        words: what is left of it.
    """
    return _run(_PIXEL, _SLIDER % {"slider": slider} + _DIVIDER % {"words": html.escape(words, quote=True)})


def folded_on_phones() -> str:
    """HTML that folds viser's panel once where it would cover the picture."""
    return _run(_PIXEL, _FOLD % {"narrow": NARROW})


def _run(source: str, script: str) -> str:
    """An image that is not seen; once it is in the page, a script runs with it as ``this``."""
    code = html.escape("{" + script + "}", quote=True)
    return f'<img src="{source}" style="width:0;height:0;position:absolute" onload="{code}">'
