/* Runs two instances of a source FMU with FMI 3.0, with states kept and restored. */

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include "fmi3Functions.h"

static void log_message(fmi3InstanceEnvironment e, fmi3Status status, fmi3String category,
                        fmi3String message)
{
    (void)e, (void)status, (void)category, (void)message;
}

static int failed(const char *what)
{
    fprintf(stderr, "%s\n", what);
    return 1;
}

static fmi3Instance made(const char *token)
{
    return fmi3InstantiateCoSimulation("x", token, "", false, false, false, false, NULL, 0, NULL,
                                       log_message, NULL);
}

int main(void)
{
    if (made("other"))
        return failed("another token was accepted");
    fmi3Instance two[2];
    fmi3ValueReference command = 1, output = 2, time = 0;
    for (int i = 0; i < 2; i++) {
        two[i] = made(TOKEN_GIVEN);
        if (!two[i])
            return failed("no instance");
        fmi3EnterInitializationMode(two[i], false, 0.0, 0.0, false, 0.0);
        fmi3ExitInitializationMode(two[i]);
    }
    fmi3Float64 one = 1.0, first, second, nothing = NAN, last;
    fmi3Boolean event, terminate, early;
    fmi3FMUState state = NULL, restored = NULL;
    for (int k = 0; k < 1000; k++)
        for (int i = 0; i < 2; i++) {
            if (fmi3SetFloat64(two[i], &command, 1, &one, 1) != fmi3OK)
                return failed("a command was refused");
            if (fmi3DoStep(two[i], 0.3 * k, 0.3, true, &event, &terminate, &early, &last) != fmi3OK)
                return failed("a step was refused");
        }
    fmi3GetFloat64(two[0], &output, 1, &first, 1);
    fmi3GetFloat64(two[1], &output, 1, &second, 1);
    if (first != second)
        return failed("equal instances differ");
    if (fmi3SetFloat64(two[0], &time, 1, &one, 1) == fmi3OK)
        return failed("the time was set");
    if (fmi3SetFloat64(two[0], &output, 1, &one, 1) == fmi3OK)
        return failed("an output was set");
    if (fmi3SetFloat64(two[0], &command, 1, &nothing, 1) == fmi3OK)
        return failed("a command that is no number was taken");
    size_t size;
    fmi3GetFMUState(two[0], &state);
    fmi3SerializedFMUStateSize(two[0], state, &size);
    fmi3Byte *bytes = malloc(size);
    fmi3SerializeFMUState(two[0], state, bytes, size);
    fmi3DeserializeFMUState(two[1], bytes, size, &restored);
    fmi3SetFMUState(two[1], restored);
    fmi3FreeFMUState(two[0], &state);
    fmi3FreeFMUState(two[1], &restored);
    free(bytes);
    for (int i = 0; i < 2; i++) {
        fmi3Reset(two[i]);
        fmi3Terminate(two[i]);
        fmi3FreeInstance(two[i]);
    }
    return 0;
}
