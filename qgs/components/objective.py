"""`qgs/one_pass`: one forward pass of all input views, judged on the target views (TokenGS)."""

from qgs.contracts import Objective, Outcome, Passes
from qgs.types import Views


class OnePass(Objective):
    """The recipe's losses of one prediction from all input views."""

    name = "one_pass"

    def forward(self, inputs: Views, targets: Views, passes: Passes) -> Outcome:
        return passes.judge(passes.predict(inputs), targets, inputs)
