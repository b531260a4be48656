/* What both interfaces, of FMI 2.0 and 3.0, use. A twin stands above this text, one of them below. */

#define LEFT                                                                                        \
    "commands or states are outside the training range; the outputs there are extrapolated"

/* The value of a Boolean variable, -1 if there is no such variable. */
static int flag(Twin *twin, uint32_t reference)
{
    if (reference == NOISY)
        return twin->noisy != 0;
#ifdef RANGED
    if (reference == OUTSIDE) {
        if (!twin->begun)
            begin(twin), twin->begun = 0;
        evaluate(twin);
        return twin->outside;
    }
#endif
    return -1;
}
