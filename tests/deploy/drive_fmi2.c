/* Runs two instances of a source FMU with FMI 2.0, with states kept and restored. */

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include "fmi2Functions.h"

static void log_message(fmi2ComponentEnvironment e, fmi2String name, fmi2Status status,
                        fmi2String category, fmi2String message, ...)
{
    (void)e, (void)name, (void)status, (void)category, (void)message;
}

static int failed(const char *what)
{
    fprintf(stderr, "%s\n", what);
    return 1;
}

int main(void)
{
    fmi2CallbackFunctions callbacks = {log_message, calloc, free, NULL, NULL};
    if (fmi2Instantiate("x", fmi2CoSimulation, "other", "", &callbacks, 0, 0))
        return failed("another guid was accepted");
    fmi2Component two[2];
    fmi2ValueReference command = 1, output = 2, time = 0;
    for (int i = 0; i < 2; i++) {
        two[i] = fmi2Instantiate("x", fmi2CoSimulation, TOKEN_GIVEN, "", &callbacks, 0, 0);
        if (!two[i])
            return failed("no instance");
        fmi2SetupExperiment(two[i], 0, 0.0, 0.0, 0, 0.0);
        fmi2EnterInitializationMode(two[i]);
        fmi2ExitInitializationMode(two[i]);
    }
    fmi2Real one = 1.0, first, second, nothing = NAN;
    fmi2FMUstate state = NULL, restored = NULL;
    for (int k = 0; k < 1000; k++)
        for (int i = 0; i < 2; i++) {
            if (fmi2SetReal(two[i], &command, 1, &one) != fmi2OK)
                return failed("a command was refused");
            if (fmi2DoStep(two[i], 0.3 * k, 0.3, fmi2True) != fmi2OK)
                return failed("a step was refused");
        }
    fmi2GetReal(two[0], &output, 1, &first);
    fmi2GetReal(two[1], &output, 1, &second);
    if (first != second)
        return failed("equal instances differ");
    if (fmi2SetReal(two[0], &time, 1, &one) == fmi2OK)
        return failed("the time was set");
    if (fmi2SetReal(two[0], &output, 1, &one) == fmi2OK)
        return failed("an output was set");
    if (fmi2SetReal(two[0], &command, 1, &nothing) == fmi2OK)
        return failed("a command that is no number was taken");
    size_t size;
    fmi2GetFMUstate(two[0], &state);
    fmi2SerializedFMUstateSize(two[0], state, &size);
    char *bytes = malloc(size);
    fmi2SerializeFMUstate(two[0], state, bytes, size);
    fmi2DeSerializeFMUstate(two[1], bytes, size, &restored);
    fmi2SetFMUstate(two[1], restored);
    fmi2FreeFMUstate(two[0], &state);
    fmi2FreeFMUstate(two[1], &restored);
    free(bytes);
    for (int i = 0; i < 2; i++) {
        fmi2Reset(two[i]);
        fmi2Terminate(two[i]);
        fmi2FreeInstance(two[i]);
    }
    return 0;
}
