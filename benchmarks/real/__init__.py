"""The diagnosis on measured data of real arms, beside plain least squares in the same run."""
