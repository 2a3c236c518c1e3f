"""Estimation as data arrive: navigator, Kalman filter, fixed-lag smoother."""
