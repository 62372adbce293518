"""Direct registration of RGB-D frames against keyframes: pyramids, points, residuals, Gauss-Newton."""
