"""What a drawing says of instruments and parts: part ids, boxes, polygons, keypoints."""
