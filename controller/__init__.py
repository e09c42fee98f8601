"""The flight controller: Kalman filter and LQR, designed offline, run in the loop."""
