"""Verdicts in words: what stops a step, and how well a rollout met its targets."""

from ._rollout import RolloutVerdict as RolloutVerdict
from ._rollout import explain_rollout as explain_rollout
from ._step import StepVerdict as StepVerdict
from ._step import explain_step as explain_step
