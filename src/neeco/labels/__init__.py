"""What a drawing says of instruments and parts: which pixel is which, boxes, polygons, keypoints."""
