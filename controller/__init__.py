"""Flight controller: Kalman filter and LQR, designed offline and run in the loop."""
