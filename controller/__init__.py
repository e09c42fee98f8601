"""Flight controller of the hovercraft: Kalman filter and LQR, designed offline and executed in the loop."""
