"""Does it help? Models trained on recorded and on drawn images, tested on recorded frames."""
