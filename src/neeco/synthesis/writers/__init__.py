"""Data set writers: plain folders, COCO, YOLO, WebDataset, BOP, Hugging Face imagefolder. All index files are made from
the per-image records."""
