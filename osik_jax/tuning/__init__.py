"""Tuning of weights, gains, damping and limits by the gradient through closed-loop rollouts."""

from ._evaluate import evaluate as evaluate
from ._loop import Loop as Loop
from ._loop import Scenarios as Scenarios
from ._losses import ComMargin as ComMargin
from ._losses import Effort as Effort
from ._losses import JointLimitDistance as JointLimitDistance
from ._losses import Smoothness as Smoothness
from ._losses import Tracking as Tracking
from ._parameters import Parameter as Parameter
from ._tune import tune as tune
