"""Operations on images: band-pass, blur, interpolation, binning."""
