"""The datagen benchmark."""
