"""Files of pictures, videos and cameras, and what their headers say of colour."""
