"""Control by prediction: linear and nonlinear, warm-started from one sample to the next."""
