"""Does it help? Models trained on recorded and on synthetic images, tested on recorded frames."""
