"""Extended set-membership filter: an ellipsoid that is guaranteed to hold the state and the losses while noise keeps its bounds."""

from __future__ import annotations

from rotorwatch_lab.maths.set_membership import SetMembership


class ESMF(SetMembership):
    """See `set_membership`; Scholte and Campbell, Int. J. Robust Nonlinear Control 13, 2003."""

    name = "esmf"
    not_kalman = "its sets hold all states that bounded noise allows: an ellipsoid's shape is no covariance"
