"""Labels of rendered instruments: of pixels (`labellers`), masks (`drawing`) and whole instruments (`annotation`)."""
