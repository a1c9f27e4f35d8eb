"""What photos show: bars, a still background, an image circle, a panorama, or nothing."""
