"""Networks that learn what no named effect explains, and the networks that judge pictures.

approximator         irradiance plus the correction of one of the networks below, and its file
compact_network      the small network of the headset's loop
published_generator  the network of Chakravarthula et al. 2020
unet, pix2pix, pix2pixhd    networks to compare with
discriminator        the discriminator of the adversarial loss
perceptual_loss, lpips, pretrained_features, weight_files   VGG-19, LPIPS, and how their weights are read
initialiser_network  a first phase for the solver
onnx_files           an approximator as ONNX

All approximators map linear irradiance [B, C, H, W], about 1 in the mean, to irradiance of the same shape. The C
planes are the bench's colours in its order: three in the paper, fewer where the bench has fewer.
"""
