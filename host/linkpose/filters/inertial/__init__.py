"""The inertial core: strapdown integration with the sensor error parameters in the state.

`state` defines the layout, `propagate` advances mean and covariance, `update` holds the Kalman updates, each other
module holds one measurement model, `hypotheses` mixes two filters, and `process` runs them over blocks of samples.
"""
