"""Data set writers: plain folders, COCO, YOLO. All index files are made from the per-image records."""
