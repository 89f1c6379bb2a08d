"""What is instrument in an image, by what the learned tissue does not explain."""
