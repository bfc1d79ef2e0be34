"""The loop that users close: gap, cause by name, patched model, no gap; in MuJoCo, no own model.

The real arm is a MuJoCo model with an effect put in by code of its own (springs in the model, a
delay in the control loop, a link cut into pieces), never by the product's patch.
"""
