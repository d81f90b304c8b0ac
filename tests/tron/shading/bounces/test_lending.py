"""Light of surfels in place of shadow rays from pixels: lent among neighbours, composited, no ray traced."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.tron.shading.scenes import ball_above_floor
from tron.cameras import Camera
from tron.estimation import FINAL, PREVIEW, Estimation
from tron.relighting import Relighter
from tron.shading.bounces.lending import Lending
from tron.tracing import SurfelTracer
